//! What the process asks of the system: signals and limits.

/// Sets what holds from the start. A limit of file sizes (`ulimit -f`) is an error of the write that exceeds it, not the end of the
/// process. That readers of stdout or stderr go away is an error, too (Rust ignores SIGPIPE), so that a run goes on. As many files may
/// be open as the system lets this process have: outputs keep those of their chunks.
pub fn set_up() {
    #[cfg(unix)]
    {
        ignore_signal(libc::SIGXFSZ);
        // SAFETY: zeroes are a valid `rlimit`, and both calls take one of ours.
        unsafe {
            let mut files: libc::rlimit = std::mem::zeroed();
            if libc::getrlimit(libc::RLIMIT_NOFILE, &mut files) == 0 {
                files.rlim_cur = files.rlim_max;
                libc::setrlimit(libc::RLIMIT_NOFILE, &files);
            }
        }
    }
}

/// Signals that would stop a run and that whoever started it had ignored (`nohup`, a shell's background job): they stay so.
pub fn ignored_signals() -> Vec<i32> {
    #[cfg(unix)]
    {
        let is_ignored = |signal: &i32| {
            // SAFETY: zeroes are a valid `sigaction`, and with no new action the call only fills it in.
            unsafe {
                let mut now: libc::sigaction = std::mem::zeroed();
                libc::sigaction(*signal, std::ptr::null(), &mut now) == 0 && now.sa_sigaction == libc::SIG_IGN
            }
        };
        [libc::SIGINT, libc::SIGTERM, libc::SIGHUP].into_iter().filter(is_ignored).collect()
    }
    #[cfg(not(unix))]
    Vec::new()
}

pub fn ignore_signal(signal: i32) {
    #[cfg(unix)]
    // SAFETY: a valid disposition of a signal that exists.
    unsafe {
        libc::signal(signal, libc::SIG_IGN);
    }
    let _ = signal;
}
