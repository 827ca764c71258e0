//! Masks on the device: bytes behind the source's voxels, 1 where a voxel is needed. The host makes them, since it reads what
//! they hang on before anything else.

use super::levels::Slab;
use super::record::{Bind, Buffer, Shader, rounded};
use super::recorder::Recorder;
use crate::grid::Region;

/// What the dispatch does; `struct Masked` of `shaders/masked.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Masked {
    pub out: [u32; 2],
    pub strides: [u32; 2],
    pub fill: u32,
    pub threads: u32,
    pub spare: [u32; 2],
}

/// The mask of a step over a box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mask {
    /// The step of the flow whose outputs it masks.
    pub step: usize,
    pub region: Region,
    /// First byte among those that the host writes.
    pub from: u64,
}

impl Mask {
    /// Bytes per packed row, a whole number of words.
    pub fn pitch(&self) -> usize {
        self.region.shape()[2].next_multiple_of(4)
    }

    /// Bytes that it takes, so that another may stand behind it.
    pub fn bytes(&self) -> u64 {
        let [nz, ny, _] = self.region.shape();
        rounded((nz * ny * self.pitch()) as u64)
    }

    pub fn bind(&self) -> Bind {
        Bind { buffer: Buffer::Source, from: self.from }
    }

    /// Where a part of the box starts, and the strides of planes and rows, in bytes.
    pub fn start(&self, part: &Region) -> [u32; 3] {
        Slab { bind: self.bind(), region: self.region, pitch: self.pitch() }.start(part)
    }

    /// The bits of `fill` where nothing of a channel over the mask's box, densely packed, is needed.
    pub fn fill(&self, channel: Bind, fill: f32, to: &mut Recorder) {
        let [_, ny, nx] = self.region.shape();
        let [_, plane, row] = self.start(&self.region);
        let masked = Masked {
            out: [ny as u32, nx as u32],
            strides: [plane, row],
            fill: fill.to_bits(),
            threads: self.region.voxels() as u32,
            spare: [0; 2],
        };
        to.dispatch(Shader::Masked, 0, &masked, &[self.bind(), channel], masked.threads);
    }
}
