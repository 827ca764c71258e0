//! How fast a device moves memory, which passes are measured by, and what keeps it from idling meanwhile. For benches.

use std::time::Instant;

use super::engine::{Gpu, GpuError, Times, run_part};
use super::record::{Recording, Shader};
use super::recorder::Recorder;

/// What one dispatch does; `struct Copy` of `shaders/copy.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Copy {
    threads: u32,
    spare: [u32; 3],
}

/// Larger than caches.
const BYTES: u64 = 256 << 20;
/// Copies of a call.
const COPIES: usize = 8;

impl Gpu {
    /// Bytes per second that a pass reads and writes, both counted, which does nothing but copy. `None` without time stamps
    /// ([`Gpu::open_timed`]).
    ///
    /// # Errors
    /// A failure of the device.
    pub fn copy_rate(&self) -> Result<Option<f64>, GpuError> {
        let times = self.copies()?;
        let least = times.passes.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
        Ok(least.is_finite().then(|| 2.0 * self.copied() as f64 / least))
    }

    /// Keeps the device busy for a while: one that idles takes its time before its clock is up.
    ///
    /// # Errors
    /// A failure of the device.
    pub fn keep_busy(&self, seconds: f64) -> Result<(), GpuError> {
        let start = Instant::now();
        while start.elapsed().as_secs_f64() < seconds {
            self.copies()?;
        }
        Ok(())
    }

    fn copied(&self) -> u64 {
        BYTES.min(self.cap()) / 256 * 256
    }

    fn copies(&self) -> Result<Times, GpuError> {
        let recording = recorded(self.copied());
        self.attempt(|device| {
            let mut times = Times::default();
            run_part(device, &recording, &mut |_| true, &mut |_| Ok(()), &mut times)?;
            Ok(times)
        })
    }
}

fn recorded(bytes: u64) -> Recording {
    let mut recorder = Recorder::new(4);
    let pair = [(); 2].map(|()| recorder.take(bytes));
    let copy = Copy { threads: (bytes / 16) as u32, ..Copy::default() };
    for k in 0..COPIES {
        let bind = [pair[k % 2].into(), pair[(k + 1) % 2].into()];
        recorder.dispatch(Shader::Copy, 0, &copy, &bind, copy.threads);
    }
    recorder.read(pair[0].into(), 4);
    recorder.finish().expect("copies take two buffers")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recording_is_sound() {
        let recording = recorded(1 << 20);
        assert_eq!((recording.fault(), recording.dispatches().count()), (None, COPIES));
    }
}
