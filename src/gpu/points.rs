//! Steps that look at one voxel, as data: which operation, of which channels, with which constants.

use super::levels::{Slab, words};
use super::record::{Bind, Buffer, FLAG_BYTES, Shader};
use super::recorder::Recorder;
use super::stored::Stored;
use crate::grid::{Affine, Region};
use crate::stage::{CombineKind, TransferPoint, WindowMode};

/// Most channels of one operation.
pub const MOST: usize = 3;

/// One channel as the shader reads it; `struct Channel` of `shaders/point.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Channel {
    pub start: [u32; 3],
    pub packing: u32,
    pub sign: u32,
    pub scaled: u32,
    pub slope: [u32; 2],
    pub intercept: [u32; 2],
    pub spare: [u32; 2],
}

/// What the dispatch does; `struct Point` of `shaders/point.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Point {
    pub out: [u32; 2],
    pub op: u32,
    pub count: u32,
    pub table: u32,
    pub component: u32,
    pub threads: u32,
    pub inputs: u32,
    pub constants: [[u32; 2]; 2],
    pub channels: [Channel; MOST],
}

/// `struct Marks` of `shaders/marks.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Marks {
    pub threads: u32,
    pub spare: [u32; 3],
}

/// An operation; [`crate::kernel::pointwise`] says what each does.
#[derive(Debug, Clone, PartialEq)]
pub enum Op {
    /// The value, scaled.
    Scale,
    Window {
        low: f64,
        high: f64,
        mode: WindowMode,
    },
    ByVariance {
        sigma_max2: f64,
    },
    BySaliency {
        threshold: f64,
        gain: f64,
    },
    Light {
        k: f64,
    },
    Combine(CombineKind),
    /// Entry 1 to 4 (opacity, red, green, blue) of a table.
    Transfer {
        points: Vec<TransferPoint>,
        component: usize,
    },
    /// Of a vector.
    Length,
    Times {
        by: f64,
    },
    /// The sum of contributions as a share of the greatest one; NaN where channel 1 is.
    Share {
        of: u32,
    },
}

/// A channel that an operation reads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Read {
    pub slab: Slab,
    /// How its voxels are stored.
    pub stored: Stored,
    pub affine: Affine,
}

impl Op {
    fn number(&self) -> u32 {
        match self {
            Op::Scale => 0,
            Op::Window { mode: WindowMode::Keep, .. } => 1,
            Op::Window { mode: WindowMode::Stretch, .. } => 2,
            Op::ByVariance { .. } => 3,
            Op::BySaliency { .. } => 4,
            Op::Combine(CombineKind::Add) => 5,
            Op::Combine(CombineKind::Multiply) => 6,
            Op::Combine(CombineKind::Min) => 7,
            Op::Combine(CombineKind::Max) => 8,
            Op::Combine(CombineKind::Mean) => 9,
            Op::Light { .. } => 10,
            Op::Transfer { .. } => 11,
            Op::Length => 12,
            Op::Times { .. } => 13,
            Op::Share { .. } => 14,
        }
    }

    fn constants(&self) -> [f64; 2] {
        match *self {
            Op::Window { low, high, .. } => [low, high],
            Op::ByVariance { sigma_max2 } => [sigma_max2, 0.0],
            Op::BySaliency { threshold, gain } => [threshold, gain],
            Op::Light { k } => [k, 0.0],
            Op::Times { by } => [by, 0.0],
            Op::Share { of } => [of as f64, 0.0],
            _ => [0.0; 2],
        }
    }

    /// The operation over a box that every channel covers.
    pub fn record(&self, reads: &[Read], region: &Region, out: Bind, to: &mut Recorder) {
        let shape = region.shape();
        let mut channels = [Channel::default(); MOST];
        for (channel, read) in channels.iter_mut().zip(reads) {
            let Stored { voxel, signed, real } = read.stored;
            *channel = Channel {
                start: read.slab.start(region),
                packing: if real { 3 } else { [2, 1, 0, 4][voxel - 1] },
                sign: if signed { 1 << (8 * voxel - 1) } else { 0 },
                scaled: !read.affine.is_identity() as u32,
                slope: words(read.affine.slope),
                intercept: words(read.affine.intercept),
                spare: [0; 2],
            };
        }
        let (mut count, mut table, mut entry) = (reads.len() as u32, 0, 0);
        if let Op::Transfer { points, component } = self {
            (count, entry) = (points.len() as u32, *component as u32);
            table = to.table(points.iter().flatten().flat_map(|v| words(*v)));
        }
        let point = Point {
            out: [shape[1] as u32, shape[2] as u32],
            op: self.number(),
            count,
            table,
            component: entry,
            threads: shape.iter().product::<usize>() as u32,
            inputs: reads.len() as u32,
            constants: self.constants().map(words),
            channels,
        };
        let bind = |c: usize| reads.get(c).unwrap_or(&reads[0]).slab.bind;
        let tables = Buffer::Tables.into();
        to.dispatch(Shader::Point, 0, &point, &[bind(0), out, bind(1), bind(2), tables], point.threads);
    }
}

/// Raises a flag where one of so many results is left to the CPU.
pub fn look(results: Bind, count: usize, flag: Buffer, to: &mut Recorder) {
    let marks = Marks { threads: count as u32, spare: [0; 3] };
    to.dispatch(Shader::Marks, 0, &marks, &[results, flag.into()], marks.threads);
}

/// Bytes of a flag that comes back.
pub const LOOKED: u64 = FLAG_BYTES;
