//! What windows see beyond the volume, made on the device, so that steps with any border read what others read.

use super::levels::Slab;
use super::points::Read;
use super::record::Shader;
use super::recorder::Recorder;
use super::stored::pitch;
use crate::grid::{Border, Region};

/// What the dispatch does; `struct Extend` of `shaders/extend.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Extend {
    pub out: [u32; 2],
    pub words: u32,
    pub strides: [u32; 2],
    pub packing: u32,
    pub kind: u32,
    pub outside: u32,
    pub lo: [i32; 3],
    pub size: [i32; 3],
    pub from: [i32; 3],
    pub threads: u32,
    pub spare: [u32; 2],
}

/// A border rule, and the bits of its constant in the type of what it is applied to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beyond {
    pub border: Border,
    pub outside: u32,
}

impl Beyond {
    /// A channel over all of a box that reaches beyond the volume, from a part of it inside; `None` where it is there as it is.
    pub(super) fn record(&self, read: &Read, wanted: &Region, volume: &Region, to: &mut Recorder) -> Option<Read> {
        if self.border == Border::Clip || volume.contains(wanted) {
            return None;
        }
        let (slab, [nz, ny, nx]) = (read.slab, wanted.shape());
        let packing = [2u32, 1, 0, 0][read.stored.voxel - 1];
        let words = pitch(nx, read.stored.voxel) >> packing;
        let threads = nz * ny * words;
        let made = to.take(threads as u64 * 4);
        let [_, plane, row] = slab.start(&slab.region);
        let of = |lo: [i64; 3]| std::array::from_fn(|a| (lo[a] - volume.lo[a]) as i32);
        let extend = Extend {
            out: [ny as u32, nx as u32],
            words: words as u32,
            strides: [plane, row],
            packing,
            kind: match self.border {
                Border::Clip | Border::Nearest => 0,
                Border::Reflect => 1,
                Border::Constant(_) => 2,
            },
            outside: self.outside & (u32::MAX >> (32 - 8 * read.stored.voxel as u32)),
            lo: of(wanted.lo),
            size: volume.shape().map(|n| n as i32),
            from: of(slab.region.lo),
            threads: threads as u32,
            spare: [0; 2],
        };
        to.dispatch(Shader::Extend, 0, &extend, &[slab.bind, made.into()], extend.threads);
        Some(Read { slab: Slab { bind: made.into(), region: *wanted, pitch: words << packing }, ..*read })
    }
}
