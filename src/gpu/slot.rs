//! The buffers of one brick on its way through the device: made once, grown when a larger brick comes, reused.

use super::passes::{MOST_PASSES, PASS_STRIDE, Sizes};

/// Buffers with the bytes that they hold.
#[derive(Default)]
pub struct Slot {
    /// Host to device: parameters of the passes, then packed voxels.
    pub upload: Held,
    pub params: Held,
    pub source: Held,
    pub a: Held,
    pub b: Held,
    /// Device to host.
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
        if self.buffer.is_none() || self.bytes < bytes {
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
        let params = MOST_PASSES * PASS_STRIDE;
        self.upload.grow(device, "upload", sizes.upload(), U::MAP_WRITE | U::COPY_SRC);
        self.params.grow(device, "params", params, U::UNIFORM | U::COPY_DST);
        self.source.grow(device, "source", sizes.source, U::STORAGE | U::COPY_DST);
        self.a.grow(device, "a", sizes.a, U::STORAGE | U::COPY_SRC);
        self.b.grow(device, "b", sizes.b, U::STORAGE);
        self.read.grow(device, "read", sizes.read, U::MAP_READ | U::COPY_DST);
    }

    /// Forgets every buffer, so that the next use makes new ones (after an error a buffer may be mapped or invalid).
    pub fn clear(&mut self) {
        *self = Slot::default();
    }
}
