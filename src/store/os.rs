//! What systems do each in their own way: reads and writes at a place of a file, room on a disk, folders made durable. Runs are
//! tested on Linux; what stands here for others was compiled for them, no more.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Duration;

#[cfg(unix)]
pub use std::os::unix::fs::FileExt;

/// The calls of the Unix trait of this name.
#[cfg(windows)]
pub trait FileExt {
    fn read_at(&self, buf: &mut [u8], offset: u64) -> io::Result<usize>;
    fn write_at(&self, buf: &[u8], offset: u64) -> io::Result<usize>;

    fn read_exact_at(&self, mut buf: &mut [u8], mut offset: u64) -> io::Result<()> {
        while !buf.is_empty() {
            match self.read_at(buf, offset) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(n) => (buf, offset) = (&mut buf[n..], offset + n as u64),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }

    fn write_all_at(&self, mut buf: &[u8], mut offset: u64) -> io::Result<()> {
        while !buf.is_empty() {
            match self.write_at(buf, offset) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(n) => (buf, offset) = (&buf[n..], offset + n as u64),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }
}

#[cfg(windows)]
impl FileExt for File {
    fn read_at(&self, buf: &mut [u8], offset: u64) -> io::Result<usize> {
        std::os::windows::fs::FileExt::seek_read(self, buf, offset)
    }

    fn write_at(&self, buf: &[u8], offset: u64) -> io::Result<usize> {
        std::os::windows::fs::FileExt::seek_write(self, buf, offset)
    }
}

/// A folder, opened as a file: to lock it.
pub fn open_folder(folder: &Path) -> io::Result<File> {
    #[cfg(windows)]
    {
        use std::os::windows::fs::OpenOptionsExt;
        const FILE_FLAG_BACKUP_SEMANTICS: u32 = 0x0200_0000;
        std::fs::OpenOptions::new().read(true).custom_flags(FILE_FLAG_BACKUP_SEMANTICS).open(folder)
    }
    #[cfg(not(windows))]
    File::open(folder)
}

/// Whether an open folder is still the one of that name. Where the system gives folders no number: whether there is one.
pub fn is_at(open: &File, folder: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let place = |meta: io::Result<std::fs::Metadata>| meta.ok().map(|m| (m.dev(), m.ino()));
        let mine = place(open.metadata());
        mine.is_some() && mine == place(std::fs::metadata(folder))
    }
    #[cfg(not(unix))]
    {
        let _ = open;
        folder.is_dir()
    }
}

/// Time that this thread has had a core; `None` where the system does not say.
pub fn thread_time() -> Option<Duration> {
    #[cfg(unix)]
    {
        // SAFETY: `timespec` is plain numbers, for which all zeros is a value, and outlives the call.
        let (code, t) = unsafe {
            let mut t: libc::timespec = std::mem::zeroed();
            (libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &mut t), t)
        };
        (code == 0).then(|| Duration::new(t.tv_sec as u64, t.tv_nsec as u32))
    }
    #[cfg(not(unix))]
    None
}

/// Private resident memory of this process: anonymous pages, not mapped files. `None` where the system does not say.
pub fn private_bytes() -> Option<u64> {
    #[cfg(target_os = "linux")]
    {
        // Pages: of all memory, resident, of these those of files and shared ones. Asked after each brick: the readable form of
        // the same numbers takes the kernel several times as long.
        let text = std::fs::read_to_string("/proc/self/statm").ok()?;
        let mut pages = text.split_whitespace().skip(1).map_while(|n| n.parse::<u64>().ok());
        let (resident, shared) = (pages.next()?, pages.next()?);
        // SAFETY: asks for a number.
        let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
        Some(resident.saturating_sub(shared) * u64::try_from(page).ok()?)
    }
    #[cfg(not(target_os = "linux"))]
    None
}

/// Bytes free for this user on the disk of `folder`; `None` where the system cannot say.
#[cfg(unix)]
pub fn free_bytes(folder: &Path) -> Option<u64> {
    use std::os::unix::ffi::OsStrExt;
    let path = std::ffi::CString::new(folder.as_os_str().as_bytes()).ok()?;
    // SAFETY: `statvfs` is plain numbers, for which all zeros is a value; the path is NUL-terminated and the struct
    // outlives the call.
    let (code, stat) = unsafe {
        let mut stat: libc::statvfs = std::mem::zeroed();
        (libc::statvfs(path.as_ptr(), &mut stat), stat)
    };
    #[allow(clippy::unnecessary_cast)] // other systems have other widths here
    let free = (stat.f_bavail as u64).saturating_mul(stat.f_frsize as u64);
    (code == 0).then_some(free)
}

#[cfg(not(unix))]
pub fn free_bytes(_: &Path) -> Option<u64> {
    None
}

/// Makes all that was written to the file system of a folder durable; false where the system has no such call.
pub fn sync_file_system(folder: &Path) -> io::Result<bool> {
    #[cfg(target_os = "linux")]
    {
        let file = File::open(folder)?;
        // SAFETY: the descriptor is open.
        match unsafe { libc::syncfs(std::os::fd::AsRawFd::as_raw_fd(&file)) } {
            0 => Ok(true),
            _ => Err(io::Error::last_os_error()),
        }
    }
    #[cfg(not(target_os = "linux"))]
    {
        let _ = folder;
        Ok(false)
    }
}

/// Makes a folder's entries durable. Windows opens no folders, and its file systems keep their entries by themselves.
pub fn sync_dir(folder: &Path) -> io::Result<()> {
    if cfg!(windows) { Ok(()) } else { File::open(folder)?.sync_all() }
}

/// Reserves room on disk, so that later writes into a mapping cannot fail for want of it.
pub fn reserve(file: &File, bytes: u64) -> io::Result<()> {
    let had = file.metadata()?.len();
    if had != bytes {
        file.set_len(bytes)?;
    }
    #[cfg(target_os = "linux")]
    {
        // SAFETY: a valid descriptor and plain numbers.
        match unsafe { libc::posix_fallocate(std::os::fd::AsRawFd::as_raw_fd(file), 0, bytes as libc::off_t) } {
            0 => Ok(()),
            // File systems without the call extend sparse; the size is set already.
            libc::EOPNOTSUPP | libc::EINVAL => Ok(()),
            code => Err(io::Error::from_raw_os_error(code)),
        }
    }
    #[cfg(not(target_os = "linux"))]
    {
        // No call that every system has: what is written is there.
        let zeros = vec![0; 1 << 20];
        (had..bytes)
            .step_by(zeros.len())
            .try_for_each(|at| file.write_all_at(&zeros[..zeros.len().min((bytes - at) as usize)], at))
    }
}

/// Tells the system that these bytes of a map of a file, whole pages, will not be wanted soon.
pub fn forget(map: &memmap2::Mmap, start: usize, len: usize) {
    #[cfg(unix)]
    {
        // SAFETY: the map is read-only and backed by its file, so dropped pages come back with the same bytes.
        let _ = unsafe { map.unchecked_advise_range(memmap2::UncheckedAdvice::DontNeed, start, len) };
    }
    #[cfg(not(unix))]
    let _ = (map, start, len);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reserved_room_has_its_size_and_keeps_what_was_there() {
        let mut file = tempfile::tempfile().unwrap();
        std::io::Write::write_all(&mut file, b"abc").unwrap();
        reserve(&file, 5000).unwrap();
        let mut bytes = [1; 4];
        file.read_exact_at(&mut bytes, 1).unwrap();
        assert_eq!((&bytes, file.metadata().unwrap().len()), (b"bc\0\0", 5000));
        reserve(&file, 2).unwrap();
        assert_eq!(file.metadata().unwrap().len(), 2);
        assert!(free_bytes(&std::env::temp_dir()).is_none_or(|n| n > 0));
        assert!(free_bytes(Path::new("/no/such/folder")).is_none());
    }
}
