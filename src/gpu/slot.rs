//! The buffers of one brick on its way through the device: made once, grown when a larger brick comes, reused.

use super::record::{Buffer, STAMP_BYTES, Sizes, WORK};

/// Buffers with the bytes that they hold.
#[derive(Default)]
pub struct Slot {
    /// Host to device: parameters of the dispatches, tables, packed voxels.
    pub upload: Held,
    pub params: Held,
    pub tables: Held,
    pub source: Held,
    pub work: [Held; WORK],
    /// Device to host: results, then time stamps.
    pub read: Held,
}

#[derive(Default)]
pub struct Held {
    buffer: Option<wgpu::Buffer>,
    bytes: u64,
}

impl Held {
    /// Panics before the first [`Slot::grow`].
    pub fn get(&self) -> &wgpu::Buffer {
        self.buffer.as_ref().expect("a slot is grown before it is used")
    }

    fn grow(&mut self, device: &wgpu::Device, label: &str, bytes: u64, usage: wgpu::BufferUsages) {
        if bytes > 0 && (self.buffer.is_none() || self.bytes < bytes) {
            self.buffer = None; // freed first: both need not fit
            let desc = wgpu::BufferDescriptor { label: Some(label), size: bytes, usage, mapped_at_creation: false };
            self.buffer = Some(device.create_buffer(&desc));
            self.bytes = bytes;
        }
    }
}

impl Slot {
    /// Makes every buffer large enough. Failures come through the device's error scopes.
    pub fn grow(&mut self, device: &wgpu::Device, sizes: Sizes) {
        use wgpu::BufferUsages as U;
        self.upload.grow(device, "upload", sizes.upload(), U::MAP_WRITE | U::COPY_SRC);
        self.params.grow(device, "params", sizes.params, U::UNIFORM | U::COPY_DST);
        self.tables.grow(device, "tables", sizes.tables, U::STORAGE | U::COPY_DST);
        self.source.grow(device, "source", sizes.source, U::STORAGE | U::COPY_DST);
        for (held, bytes) in self.work.iter_mut().zip(sizes.work) {
            held.grow(device, "work", bytes, U::STORAGE | U::COPY_SRC | U::COPY_DST);
        }
        self.read.grow(device, "read", sizes.read + STAMP_BYTES, U::MAP_READ | U::COPY_DST);
    }

    pub fn of(&self, buffer: Buffer) -> &wgpu::Buffer {
        match buffer {
            Buffer::Source => self.source.get(),
            Buffer::Tables => self.tables.get(),
            Buffer::Work(i) => self.work[i as usize].get(),
        }
    }

    /// Bytes of all buffers.
    pub fn bytes(&self) -> u64 {
        let own = [&self.upload, &self.params, &self.tables, &self.source, &self.read];
        own.into_iter().chain(&self.work).map(|held| held.bytes).sum()
    }

    /// Forgets every buffer, so that the next use makes new ones (after an error a buffer may be mapped or invalid).
    pub fn clear(&mut self) {
        *self = Slot::default();
    }
}
