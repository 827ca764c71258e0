//! Puts recordings together: buffers taken and given back, tables, dispatches, what comes back. Steps that are recorded one
//! after the other share buffers, since each gives back what nobody reads any more.

use super::record::{Bind, Buffer, Command, Dispatch, FLAG_BYTES, Readback, Recording, Shader, Sizes, WORK, rounded};
use super::unfit::Unfit;

/// A recording in the making.
#[derive(Debug)]
pub struct Recorder {
    recording: Recording,
    /// By number; those beyond what a recording may have are only counted.
    busy: Vec<bool>,
}

impl Recorder {
    /// `source`: bytes of packed voxels that the host writes.
    pub fn new(source: u64) -> Recorder {
        let sizes = Sizes { source: rounded(source), ..Sizes::default() };
        Recorder { recording: Recording { sizes, ..Recording::default() }, busy: Vec::new() }
    }

    /// A buffer of at least so many bytes.
    pub fn take(&mut self, bytes: u64) -> Buffer {
        let i = self.busy.iter().position(|b| !b).unwrap_or_else(|| {
            self.busy.push(false);
            self.busy.len() - 1
        });
        self.busy[i] = true;
        if let Some(held) = self.recording.sizes.work.get_mut(i) {
            *held = rounded(bytes).max(*held);
        }
        Buffer::Work(i as u8)
    }

    /// Nobody reads it any more.
    pub fn give(&mut self, buffer: Buffer) {
        if let Buffer::Work(i) = buffer {
            self.busy[i as usize] = false;
        }
    }

    /// Where a table's words stand.
    pub fn table(&mut self, words: impl IntoIterator<Item = u32>) -> u32 {
        let start = self.recording.tables.len() as u32;
        self.recording.tables.extend(words);
        start
    }

    pub fn dispatch<P: bytemuck::Pod>(
        &mut self,
        shader: Shader,
        entry: usize,
        params: &P,
        bind: &[Bind],
        threads: u32,
    ) {
        let params = bytemuck::bytes_of(params).to_vec();
        let dispatch = Dispatch { shader, entry, parts: 0, params, bind: bind.to_vec(), threads };
        self.recording.commands.push(Command::Dispatch(dispatch));
    }

    /// Of the shader that was dispatched last only these parts are compiled.
    pub fn only(&mut self, parts: u32) {
        if let Some(Command::Dispatch(d)) = self.recording.commands.last_mut() {
            d.parts = parts;
        }
    }

    /// Zeros in so many first bytes of a buffer, a whole number of words.
    pub fn clear(&mut self, buffer: Buffer, bytes: u64) {
        self.recording.commands.push(Command::Clear(buffer, bytes));
    }

    /// A buffer whose first words are 0.
    pub fn flag(&mut self) -> Buffer {
        let flag = self.take(FLAG_BYTES);
        self.clear(flag, FLAG_BYTES);
        flag
    }

    /// Brings bytes back; says where they stand among the results.
    pub fn read(&mut self, from: Bind, bytes: u64) -> u64 {
        let to = self.recording.sizes.read;
        // Copies are of whole words; buffers are.
        let bytes = bytes.next_multiple_of(4);
        self.recording.commands.push(Command::Readback(Readback { from, bytes, to }));
        self.recording.sizes.read = to + rounded(bytes);
        to
    }

    /// The recording.
    ///
    /// # Errors
    /// It would take more buffers than there are.
    pub fn finish(mut self) -> Result<Recording, Unfit> {
        if self.busy.len() > WORK {
            return Err(Unfit::Buffers(self.busy.len()));
        }
        let params = self.recording.params().last().map_or(0, |p| p.end);
        let sizes = &mut self.recording.sizes;
        sizes.params = rounded(params);
        sizes.tables = rounded(self.recording.tables.len() as u64 * 4);
        Ok(self.recording)
    }
}

/// A box of several planes in one buffer, each from a multiple of 256 bytes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Planes {
    pub buffer: Buffer,
    /// Words from plane to plane.
    pub stride: u32,
}

impl Planes {
    /// Room for `count` planes of `voxels` words.
    pub fn take(recorder: &mut Recorder, voxels: usize, count: usize) -> Planes {
        let bytes = rounded(voxels as u64 * 4);
        Planes { buffer: recorder.take(bytes * count as u64), stride: (bytes / 4) as u32 }
    }

    pub fn plane(&self, k: usize) -> Bind {
        Bind { buffer: self.buffer, from: 4 * self.stride as u64 * k as u64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_reused_and_too_many_are_noticed() {
        let mut recorder = Recorder::new(100);
        let (a, b) = (recorder.take(100), recorder.take(1000));
        recorder.give(a);
        assert_eq!(recorder.take(5000), a);
        assert_eq!((recorder.table([1, 2]), recorder.table([3])), (0, 2));
        assert_eq!((recorder.read(b.into(), 5), recorder.read(b.into(), 8)), (0, 256));
        let recording = recorder.finish().unwrap();
        assert_eq!((&recording.sizes.work[..3], recording.sizes.read), (&[5120, 1024, 0][..], 512));
        assert_eq!((recording.fault(), recording.tables), (None, vec![1, 2, 3]));
        let mut recorder = Recorder::new(0);
        (0..=WORK).for_each(|_| assert!(matches!(recorder.take(4), Buffer::Work(_))));
        assert_eq!(recorder.finish(), Err(Unfit::Buffers(WORK + 1)));
    }
}
