//! Gaussian means: how a brick is cut into parts that fit the device, the table of weights, and one pass per axis. Pure
//! arithmetic, shared by planner and engine.

use super::passes::{Part, cut, packed};
use super::record::{Buffer, Command, Dispatch, PARAMS_STRIDE, Readback, Recording, Shader, Sizes, rounded};
use crate::grid::{DType, Shape};
use crate::kernel::gaussian;

/// What one dispatch does; `struct Taps` of `shaders/gaussian.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Taps {
    pub n: u32,
    pub at: u32,
    pub from: u32,
    pub m: u32,
    pub radius: u32,
    pub input: [u32; 3],
    pub output: [u32; 3],
    pub inner: u32,
    pub middle: u32,
    pub axis: u32,
    pub weights: u32,
    pub packing: u32,
    pub sign: u32,
    pub zero: u32,
    pub threads: u32,
    pub spare: u32,
}

/// One call, all extents `[z, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TapsJob {
    pub src: Shape,
    pub dst: Shape,
    pub at: [usize; 3],
    pub sigma: [f64; 3],
    radius: [usize; 3],
    /// Bytes of a voxel: 1 or 2.
    pub voxel: usize,
    signed: bool,
}

impl TapsJob {
    /// `None` if voxels of this type have no kernel here.
    pub fn new(dtype: DType, src: Shape, dst: Shape, at: [usize; 3], sigma: [f64; 3]) -> Option<TapsJob> {
        let (voxel, signed) = packed(dtype)?;
        Some(TapsJob { src, dst, at, sigma, radius: gaussian::shared::radius(sigma, src), voxel, signed })
    }

    fn part(&self, lo: [usize; 3], dst: Shape) -> Part {
        Part::around(self.src, self.at, self.radius, lo, dst)
    }

    /// Voxels per packed row, a whole number of words.
    pub fn pitch(&self, part: &Part) -> usize {
        part.src[2].next_multiple_of(4 / self.voxel)
    }

    fn sizes(&self, part: &Part) -> Sizes {
        let words = |s: Shape| s.iter().map(|&n| n as u64).product::<u64>() * 4;
        let ([nz, ny, _], [_, my, mx]) = (part.src, part.dst);
        let table: usize = (0..3).map(|a| part.dst[a] * self.radius[a]).sum();
        Sizes {
            params: 3 * PARAMS_STRIDE,
            tables: rounded(table as u64 * 4),
            source: rounded((nz * ny * self.pitch(part) * self.voxel) as u64),
            a: rounded(words([nz, ny, mx])),
            b: rounded(words([nz, my, mx])),
            read: rounded(words(part.dst)),
        }
    }

    /// Parts of which every buffer is at most `cap` bytes; `None` where even one voxel does not fit.
    pub fn parts(&self, cap: u64) -> Option<Vec<Part>> {
        let boxes = cut(self.dst, |lo, shape| self.sizes(&self.part(lo, shape)).largest() <= cap)?;
        Some(boxes.into_iter().map(|(lo, shape)| self.part(lo, shape)).collect())
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        let parts = self.parts(cap).unwrap_or_default();
        parts.iter().map(|p| self.sizes(p)).fold(Sizes::default(), Sizes::max)
    }

    /// x from packed voxels, then y, then z, as the CPU does it.
    pub fn record(&self, part: &Part) -> Recording {
        let mut recording = Recording { sizes: self.sizes(part), ..Recording::default() };
        let pitch = self.pitch(part);
        let mut strides = [part.src[1] * pitch, pitch, 1];
        let mut extent = part.src;
        for (entry, axis) in [(0, 2), (1, 1), (1, 0)] {
            extent[axis] = part.dst[axis];
            let next = [extent[1] * extent[2], extent[2], 1];
            let others = [[1, 2], [0, 2], [0, 1]][axis];
            let order = |s: [usize; 3]| [s[axis] as u32, s[others[0]] as u32, s[others[1]] as u32];
            let centre = self.at[axis] + part.lo[axis];
            let weights = recording.tables.len() as u32;
            for k in 0..part.dst[axis] {
                let (radius, n) = (self.radius[axis], self.src[axis]);
                let row = gaussian::shared::weights(self.sigma[axis], radius, centre + k, n);
                recording.tables.extend(row.map(f32::to_bits));
            }
            let taps = Taps {
                n: self.src[axis] as u32,
                at: centre as u32,
                from: part.from[axis] as u32,
                m: part.dst[axis] as u32,
                radius: self.radius[axis] as u32,
                input: order(strides),
                output: order(next),
                inner: extent[2] as u32,
                middle: extent[1] as u32,
                axis: axis as u32,
                weights,
                packing: if self.voxel == 1 { 2 } else { 1 },
                sign: if self.signed { 1 << (8 * self.voxel - 1) } else { 0 },
                threads: extent.iter().product::<usize>() as u32,
                ..Taps::default()
            };
            let [input, output] = [[Buffer::B, Buffer::A], [Buffer::A, Buffer::B], [Buffer::Source, Buffer::A]][axis];
            recording.commands.push(Command::Dispatch(Dispatch {
                shader: Shader::Gaussian,
                entry,
                params: bytemuck::bytes_of(&taps).to_vec(),
                bind: vec![input, output, Buffer::Tables],
                threads: taps.threads,
            }));
            strides = next;
        }
        let bytes = part.dst.iter().product::<usize>() as u64 * 4;
        recording.commands.push(Command::Readback(Readback { from: Buffer::A, bytes, to: 0 }));
        recording
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_are_sound_and_parts_tile_the_outputs() {
        // The widest kernel sees the whole source from every voxel.
        for (sigma, least) in [([0.4; 3], 30_000), ([2.0, 0.7, 3.3], 90_000), ([40.0; 3], 150_000)] {
            let job = TapsJob::new(DType::I16, [40, 30, 50], [20, 30, 40], [10, 0, 5], sigma).unwrap();
            for cap in [1 << 30, least] {
                let parts = job.parts(cap).unwrap();
                assert_eq!(parts.iter().map(|p| p.dst.iter().product::<usize>()).sum::<usize>(), 20 * 30 * 40);
                for part in &parts {
                    let recording = job.record(part);
                    assert_eq!(recording.fault(), None);
                    assert!(recording.sizes.largest() <= cap);
                    assert_eq!(recording.dispatches().count(), 3);
                }
            }
            assert!(job.parts(300).is_none());
        }
        assert!(TapsJob::new(DType::F32, [4; 3], [4; 3], [0; 3], [1.0; 3]).is_none());
    }
}
