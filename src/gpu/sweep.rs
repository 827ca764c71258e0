//! Obscurance: how a brick is cut into parts that fit the device, the tables of displacements and contributions, and one
//! dispatch (or a few) per family of lines. Pure arithmetic, shared by planner and engine.

use super::record::{Bind, Buffer, GROUP, Recording, Shader, Sizes};
use super::recorder::Recorder;
use super::stored::{Stored, pitch};
use super::unfit::{Unfit, cut_to};
use crate::grid::{DType, Region, Shape};
use crate::kernel::obscurance::{Prepared, shared};

/// A sense that is not swept.
const NOT_SWEPT: u32 = u32::MAX;

/// Cutting a brick repeats its halo. Beyond this many source voxels per voxel of the uncut box the CPU is the better place.
pub(super) const MOST_REPEATED: usize = 4;

/// What one dispatch does; `struct Lines` of `shaders/obscurance.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Lines {
    pub planes: u32,
    pub size: [u32; 2],
    pub reach: u32,
    pub code_at: u32,
    pub code: [u32; 3],
    pub out: [u32; 3],
    pub sum: [u32; 3],
    pub at: [i32; 3],
    pub shifts: u32,
    pub tables: [u32; 2],
    pub packing: u32,
    pub first: u32,
    pub threads: u32,
    pub links: u32,
    pub groups: u32,
    pub spare: [u32; 3],
}

/// Most families of one dispatch, whose parameters are an array of as many.
const TOGETHER: usize = 8;
/// Threads that fill a large GPU twice (132 x 2048 on an H200): families go side by side up to as many.
const ENOUGH: usize = 1 << 19;

/// How voxels become codes; `struct Keys` of `shaders/sweep_codes.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Keys {
    pub threads: u32,
    pub real: u32,
    pub mask: u32,
    pub flipped: u32,
}

impl Keys {
    /// Of so many words of voxels stored so.
    pub fn new(words: usize, stored: Stored, flipped: bool) -> Keys {
        let bits = 8 * stored.voxel as u32;
        let sign = if stored.signed { 1u32 << (bits - 1) } else { 0 };
        let signs = (0..32 / bits).fold(0, |m, k| m | sign << (k * bits));
        let mask = if flipped { !signs } else { signs };
        Keys { threads: words as u32, real: stored.real as u32, mask, flipped: flipped as u32 }
    }
}

/// One call: openness on `dst` of voxels that cover `src`, both in global indices.
pub struct SweepJob<'a> {
    pub sweep: &'a Prepared,
    pub src: Region,
    pub dst: Region,
    /// Bytes of a code: 1, 2 or 4.
    pub code: usize,
}

/// A box of the output and the voxels that its lines may meet, in global indices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SweepPart {
    pub dst: Region,
    pub src: Region,
}

impl SweepPart {
    /// Codes per packed row, a whole number of words.
    pub fn pitch(&self, code: usize) -> usize {
        pitch(self.src.shape()[2], code)
    }
}

/// Lines of a family that are swept at once.
#[derive(Debug, Clone, Copy)]
struct Swept {
    family: usize,
    planes: usize,
    first: usize,
    lines: usize,
}

impl<'a> SweepJob<'a> {
    /// `None` if codes of this type have more than 32 bits, or a line could have more than 2^16 - 1 planes.
    pub fn new(sweep: &'a Prepared, dtype: DType, src: Region, dst: Region) -> Option<SweepJob<'a>> {
        let code = shared::code_bytes(dtype)?;
        let short = src.shape().iter().all(|&n| n < 1 << 16);
        short.then_some(SweepJob { sweep, src, dst, code })
    }

    fn part(&self, lo: [usize; 3], shape: Shape) -> SweepPart {
        let lo: [i64; 3] = std::array::from_fn(|a| self.dst.lo[a] + lo[a] as i64);
        let dst = Region::new(lo, std::array::from_fn(|a| lo[a] + shape[a] as i64));
        SweepPart { dst, src: dst.grow(self.sweep.reach()).clip(&self.src) }
    }

    /// Parts of which every buffer is at most `cap` bytes.
    ///
    /// # Errors
    /// That is not to be had, or not worth it.
    pub fn parts(&self, cap: u64) -> Result<Vec<SweepPart>, Unfit> {
        let boxes = cut_to(self.dst.shape(), cap, |lo, shape| Ok(self.recorded(&self.part(lo, shape), cap)?.sizes))?;
        let parts: Vec<SweepPart> = boxes.into_iter().map(|(lo, shape)| self.part(lo, shape)).collect();
        repeated(parts.iter().map(|p| p.src.voxels()), self.src.voxels())?;
        Ok(parts)
    }

    /// The voxels that the lines of a family can meet on their way through a part.
    fn family_box(&self, part: &SweepPart, family: &shared::Lines) -> Region {
        part.dst.grow(family.halo()).clip(&part.src)
    }

    /// Bytes of what a line leaves at a voxel: a code and steps.
    fn entry(&self) -> u64 {
        if self.code == 4 { 8 } else { 4 }
    }

    /// Lines that are swept at once, so that their links stay below `cap` bytes: whole workgroups.
    fn batch(&self, planes: usize, lines: usize, cap: u64) -> Result<usize, Unfit> {
        let link = self.entry() * planes.max(1) as u64;
        let most = (cap / link) as usize / GROUP as usize * GROUP as usize;
        if most > 0 { Ok(lines.min(most)) } else { Err(Unfit::Bytes { needed: link * GROUP as u64, cap }) }
    }

    /// What each dispatch sweeps, by family: its number, first line and lines. Families go together where they fit.
    fn dispatches(&self, part: &SweepPart, cap: u64) -> Result<Vec<Vec<Swept>>, Unfit> {
        let extents: Vec<_> =
            self.sweep.lines().map(|family| extent(&self.family_box(part, &family), family.axis())).collect();
        let most = extents.iter().map(|e| e.1).max().unwrap_or(1).max(1);
        let mut list = Vec::new();
        let whole = |(family, &(planes, lines)): (usize, &(usize, usize))| Swept { family, planes, first: 0, lines };
        let all: Vec<Swept> = extents.iter().enumerate().map(whole).collect();
        for together in all.chunks((ENOUGH / most).clamp(1, TOGETHER)) {
            if self.entry() * together.iter().map(|s| (s.planes * s.lines) as u64).sum::<u64>() <= cap {
                list.push(together.to_vec());
                continue;
            }
            for &one in together {
                let batch = self.batch(one.planes, one.lines, cap)?;
                let cut = |first| vec![Swept { first, lines: batch.min(one.lines - first), ..one }];
                list.extend((0..one.lines).step_by(batch).map(cut));
            }
        }
        Ok(list)
    }

    /// Largest buffers of any part.
    pub fn slot(&self, cap: u64) -> Sizes {
        let parts = self.parts(cap).unwrap_or_default();
        parts.iter().map(|p| self.record(p, cap).sizes).fold(Sizes::default(), Sizes::max)
    }

    /// All families over a part, and that the sums come back. Panics for a part that [`Self::parts`] did not give for this
    /// `cap`.
    pub fn record(&self, part: &SweepPart, cap: u64) -> Recording {
        self.recorded(part, cap).expect("a part that fits")
    }

    fn recorded(&self, part: &SweepPart, cap: u64) -> Result<Recording, Unfit> {
        let [nz, ny, _] = part.src.shape();
        let mut recorder = Recorder::new((nz * ny * part.pitch(self.code) * self.code) as u64);
        let sums = self.sums(part, Buffer::Source.into(), cap, &mut recorder)?;
        recorder.read(sums.into(), part.dst.voxels() as u64 * 4);
        recorder.finish()
    }

    /// Sums of contributions over a part, left on the device, from codes of all of its source.
    ///
    /// # Errors
    /// Links do not stay below `cap` bytes.
    pub(super) fn sums(&self, part: &SweepPart, codes: Bind, cap: u64, to: &mut Recorder) -> Result<Buffer, Unfit> {
        let bytes = part.dst.voxels() as u64 * 4;
        let sums = to.take(bytes);
        to.clear(sums, bytes);
        let dispatches = self.dispatches(part, cap)?;
        let entries = |list: &Vec<Swept>| list.iter().map(|s| s.planes * s.lines).sum::<usize>();
        let links = to.take(self.entry() * dispatches.iter().map(entries).max().unwrap_or(0) as u64);
        let described: Vec<Lines> = self
            .sweep
            .lines()
            .map(|family| {
                let mut tables = Vec::new();
                let mut lines = self.lines(part, &family, &mut tables);
                let start = to.table(tables);
                lines.shifts += start;
                lines.tables = lines.tables.map(|t| if t == NOT_SWEPT { t } else { t + start });
                lines
            })
            .collect();
        for list in dispatches {
            let widest = list.iter().map(|s| s.lines as u32).max().unwrap_or(0);
            let groups = widest.div_ceil(GROUP);
            // A family that is not there has no threads.
            let mut families = [Lines { groups, ..Lines::default() }; TOGETHER];
            let mut entry = 0;
            for (to, swept) in families.iter_mut().zip(&list) {
                let (first, threads) = (swept.first as u32, swept.lines as u32);
                *to = Lines { first, threads, links: entry, groups, ..described[swept.family] };
                entry += (swept.planes * swept.lines) as u32;
            }
            let bind = [codes, sums.into(), Buffer::Tables.into(), links.into()];
            let shader = if self.code == 4 { Shader::ObscuranceWide } else { Shader::Obscurance };
            to.dispatch(shader, 0, &families, &bind, groups * GROUP * list.len() as u32);
        }
        to.give(links);
        Ok(sums)
    }

    /// Parameters of one family; its displacements and contributions are put at the end of `tables`.
    fn lines(&self, part: &SweepPart, family: &shared::Lines, tables: &mut Vec<u32>) -> Lines {
        let bounds = self.family_box(part, family);
        let order = order(family.axis());
        let (planes, _) = extent(&bounds, family.axis());
        let reach = family.reach().min(planes - 1);
        let shifts = tables.len() as u32;
        let first = bounds.lo[order[0]];
        let step = |axis: usize, k: i64| (family.displacement(axis, k) - family.displacement(axis, k - 1)) as u32;
        let both = |k: i64| step(order[1], k) & 0xffff | step(order[2], k) << 16;
        tables.extend([0].into_iter().chain((first + 1..first + planes as i64).map(both)));
        let starts = [0, 1].map(|way| match family.table(way) {
            None => NOT_SWEPT,
            Some(table) => {
                let start = tables.len() as u32;
                tables.extend_from_slice(&table[..reach]);
                tables.push(table[family.reach()]);
                start
            }
        });
        let pitch = part.pitch(self.code);
        let code = [part.src.shape()[1] * pitch, pitch, 1];
        let out = part.dst.shape();
        let sum = [out[1] * out[2], out[2], 1];
        let code_at: usize = part.src.offset_of(&bounds).iter().zip(code).map(|(o, s)| o * s).sum();
        let at = bounds.offset_of(&part.dst);
        let n = bounds.shape();
        Lines {
            planes: planes as u32,
            size: [n[order[1]] as u32, n[order[2]] as u32],
            reach: reach as u32,
            code_at: code_at as u32,
            code: order.map(|a| code[a] as u32),
            out: order.map(|a| out[a] as u32),
            sum: order.map(|a| sum[a] as u32),
            at: order.map(|a| at[a] as i32),
            shifts,
            tables: starts,
            packing: [2, 1, 0, 0][self.code - 1],
            ..Lines::default()
        }
    }
}

/// Whether parts that read so many voxels each are worth it for a box of `once`.
pub(super) fn repeated(reads: impl ExactSizeIterator<Item = usize>, once: usize) -> Result<(), Unfit> {
    let parts = reads.len();
    let read: usize = reads.sum();
    if parts == 1 || read <= MOST_REPEATED * once { Ok(()) } else { Err(Unfit::Repeated { parts, read, once }) }
}

/// Dominant axis, then the others in natural order: neighbouring threads are neighbours along the last.
fn order(axis: usize) -> [usize; 3] {
    [[0, 1, 2], [1, 0, 2], [2, 0, 1]][axis]
}

/// Planes along the dominant axis, and lines of the cross-section.
fn extent(bounds: &Region, axis: usize) -> (usize, usize) {
    let n = bounds.shape();
    (n[axis], n.iter().product::<usize>() / n[axis].max(1))
}

#[cfg(test)]
mod tests {
    use super::super::record::Command;
    use super::*;
    use crate::kernel::obscurance::ObscuranceParams;
    use crate::stage::{DirectionSet, DirectionWeights, Rho};

    fn prepared(directions: usize, max_distance: f64, spacing: [f64; 3]) -> Prepared {
        Prepared::new(&ObscuranceParams {
            directions,
            set: if directions == 7 { DirectionSet::Fibonacci } else { DirectionSet::Icosahedron },
            weights: DirectionWeights::Uniform,
            rho: Rho::Sqrt,
            max_distance,
            spacing,
            flipped: false,
            missing: None,
            ambient: [1.0; 3],
            ranks: None,
        })
    }

    /// What the shader's walk relies on: it follows each thread's line and checks that the voxels of the box are each met
    /// once, by lines that are lattice lines between two wraps.
    #[test]
    fn threads_share_out_the_box_along_lattice_lines() {
        let sweep = prepared(42, 9.0, [1.0, 0.7, 1.3]);
        let src = Region::new([3, -2, 11], [20, 12, 30]);
        let dst = Region::new([8, 1, 15], [14, 9, 24]);
        let job = SweepJob::new(&sweep, DType::U8, src, dst).unwrap();
        let part = job.parts(1 << 30).unwrap()[0];
        let mut tables = Vec::new();
        for family in sweep.lines() {
            let p = job.lines(&part, &family, &mut tables);
            let shift = |k: usize, i: u32| (tables[(p.shifts + i) as usize] >> (16 * k)) as i16 as i32;
            let bounds = job.family_box(&part, &family);
            let mut met = vec![0; bounds.voxels()];
            for line in 0..p.size[0] * p.size[1] {
                let mut at = [line / p.size[1], line % p.size[1]].map(|v| v as i32);
                for i in 0..p.planes {
                    for (k, (at, size)) in at.iter_mut().zip(p.size).enumerate() {
                        let by = shift(k, i);
                        assert!(i > 0 || by == 0);
                        assert!(by.abs() <= 1);
                        *at = (*at + by).rem_euclid(size as i32);
                    }
                    met[((i * p.size[0] + at[0] as u32) * p.size[1] + at[1] as u32) as usize] += 1;
                }
            }
            assert!(met.iter().all(|&n| n == 1));
        }
    }

    #[test]
    fn recordings_are_sound_and_links_stay_below_the_cap() {
        for (directions, distance) in [(12, 0.0), (42, 6.0), (7, 200.0)] {
            let sweep = prepared(directions, distance, [1.0; 3]);
            let src = Region::whole([40, 30, 50]);
            for (dtype, cap) in [(DType::U8, 1 << 30), (DType::U16, 200_000), (DType::F32, 250_000)] {
                let job = SweepJob::new(&sweep, dtype, src, Region::new([5, 0, 7], [40, 30, 44])).unwrap();
                let parts = job.parts(cap).unwrap();
                let voxels: usize = parts.iter().map(|p| p.dst.voxels()).sum();
                assert_eq!(voxels, job.dst.voxels());
                for part in &parts {
                    let recording = job.record(part, cap);
                    assert_eq!(recording.fault(), None);
                    assert!(recording.sizes.largest() <= cap && part.src.contains(&part.dst));
                    let voxels = part.dst.voxels() as u64;
                    assert_eq!(
                        recording
                            .commands
                            .iter()
                            .filter(|c| matches!(c, Command::Clear(_, b) if *b == 4 * voxels))
                            .count(),
                        1
                    );
                    assert!(recording.dispatches().count() >= sweep.lines().len().div_ceil(TOGETHER));
                    for d in recording.dispatches() {
                        let families: &[Lines] = bytemuck::cast_slice(&d.params);
                        let swept: Vec<_> = families.iter().filter(|f| f.threads > 0).collect();
                        assert_eq!(d.threads, swept.len() as u32 * swept[0].groups * GROUP);
                        // Links side by side, in whole.
                        let mut links = 0;
                        for f in swept {
                            assert!(f.links == links && f.threads <= f.groups * GROUP);
                            links += f.planes * f.threads;
                        }
                    }
                }
            }
        }
        let sweep = prepared(42, 6.0, [1.0; 3]);
        let whole = Region::whole([40, 30, 50]);
        assert!(SweepJob::new(&sweep, DType::F64, whole, whole).is_none());
        assert!(SweepJob::new(&sweep, DType::U8, whole, whole).unwrap().parts(2000).is_err());
    }
}
