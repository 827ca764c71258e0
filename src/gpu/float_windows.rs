//! Windows of f32 on their way back: from the device's codes and cells to results, and those that f32 pairs cannot hold by
//! the CPU kernel.

use super::engine::GpuError;
use super::flow_call::paste_floats;
use super::pairs::Cell;
use super::passes::{self, Job, Part, Quantity, result_bytes};
use super::slopes::MARKED;
use super::windows::cast;
use crate::brick::Voxels;
use crate::grid::{AnyView, AnyViewMut, Region, View, ViewMut, Voxel};
use crate::kernel::Context;
use crate::kernel::window::finish_floats::{Moments, finish_floats};
use crate::kernel::window::{self, Place, WindowOut};
use crate::stage::WindowParams;

/// Between these magnitudes of a window's largest voxel neither sums nor squares leave the normal numbers of f32.
const LARGE: f32 = (1u64 << 40) as f32;
const SMALL: f32 = 1.0 / (1u64 << 30) as f32;

/// Writes a part's voxels from what came back of it.
pub(super) fn finish(
    job: &Job,
    part: &Part,
    bytes: &[u8],
    src: View<f32>,
    params: &WindowParams,
    outs: &mut [WindowOut],
    cx: &mut Context,
) -> Result<(), GpuError> {
    if job.finish.is_some() {
        let results: &[u32] = cast(bytes)?;
        store_all(results, part, outs);
        // A plane shows it: all channels of a voxel are marked.
        if results[..part.dst.iter().product::<usize>()].contains(&MARKED) {
            redo(job, part, |i| results[i] == MARKED, src, params, outs, cx);
        }
        return Ok(());
    }
    let moments = FloatPart::new(job, part, bytes)?;
    finish_floats(src, params, job.at, outs, part.lo, part.dst, |i| moments.window(i), cx);
    redo(job, part, |i| moments.left(i), src, params, outs, cx);
    Ok(())
}

/// Copies results, one plane per channel, to their rows.
pub(super) fn store_all(results: &[u32], part: &Part, outs: &mut [WindowOut]) {
    let n: usize = part.dst.iter().product();
    // Planes come back from multiples of 256 bytes on.
    let plane = n.next_multiple_of(64);
    let results: &[f32] = bytemuck::cast_slice(results);
    outs.iter_mut().enumerate().for_each(|(c, out)| {
        paste_floats(&results[c * plane..][..n], part.dst, part.lo, &mut out.dst);
    });
}

/// The moments of a part.
struct FloatPart<'a> {
    /// Pairs of codes.
    order: &'a [[u32; 2]],
    /// Cells, or nothing where no channel needs them.
    cells: &'a [u32],
    words: usize,
}

impl<'a> FloatPart<'a> {
    fn new(job: &Job, part: &Part, bytes: &'a [u8]) -> Result<FloatPart<'a>, GpuError> {
        let mut out = FloatPart { order: &[], cells: &[], words: 0 };
        let mut from = 0;
        for quantity in job.quantities() {
            let len = result_bytes(part, quantity) as usize;
            let slice = &bytes[from..from + len];
            match quantity {
                Quantity::Moments { square } => (out.cells, out.words) = (cast(slice)?, passes::cell(square)),
                _ => out.order = cast(slice)?,
            }
            from += len.next_multiple_of(256);
        }
        Ok(out)
    }

    fn extremes(&self, i: usize) -> [f32; 2] {
        self.order[i].map(number)
    }

    fn window(&self, i: usize) -> Moments {
        let [lo, hi] = self.extremes(i);
        if self.words == 0 {
            return Moments { lo, hi, ..Moments::default() };
        }
        let cell = Cell::from_words(&self.cells[i * self.words..][..self.words]);
        Moments { lo, hi, n: cell.n, sum: cell.sum(), m2: cell.m2() }
    }

    /// Whether the CPU has to make this window: an infinity, or only voxels at the ends of f32.
    fn left(&self, i: usize) -> bool {
        if self.words == 0 || self.order[i][0] > self.order[i][1] {
            return false; // extremes are exact; a window without voxels has no moments
        }
        let [lo, hi] = self.extremes(i);
        let most = lo.abs().max(hi.abs());
        most >= LARGE || most < SMALL && most > 0.0
    }
}

/// The least box of a part that holds every window that is left to the CPU.
fn left_box(part: &Part, left: impl Fn(usize) -> bool) -> Option<Region> {
    let all = Region::whole(part.dst).iter().enumerate().filter(|(i, _)| left(*i)).map(|(_, v)| v);
    all.fold(None, |held: Option<Region>, v| {
        let one = Region::new(v, v.map(|c| c + 1));
        let least = |h: Region| std::array::from_fn(|a| h.lo[a].min(one.lo[a]));
        let most = |h: Region| std::array::from_fn(|a| h.hi[a].max(one.hi[a]));
        Some(held.map_or(one, |h| Region::new(least(h), most(h))))
    })
}

/// Makes the windows of a part that are left to the CPU: all of the box that holds them, since the CPU gives the same
/// wherever a call starts, of which those are kept.
fn redo(
    job: &Job,
    part: &Part,
    left: impl Fn(usize) -> bool,
    src: View<f32>,
    params: &WindowParams,
    outs: &mut [WindowOut],
    cx: &mut Context,
) {
    let Some(bounds) = left_box(part, &left) else { return };
    let shape = bounds.shape();
    let lo: [usize; 3] = std::array::from_fn(|a| part.lo[a] + bounds.lo[a] as usize);
    let at = std::array::from_fn(|a| job.at[a] + lo[a]);
    let voxel = std::array::from_fn(|a| job.place[a] + lo[a] as i64);
    let mut made: Vec<Voxels> = outs.iter().map(|o| Voxels::zeroed(o.dst.dtype(), bounds.voxels())).collect();
    let mut again: Vec<WindowOut> =
        (outs.iter().zip(&mut made)).map(|(o, v)| WindowOut { channel: o.channel, dst: v.view_mut(shape) }).collect();
    window::window(AnyView::F32(src), params, Place::new(at, voxel), &mut again, cx);
    let [_, ny, nx] = part.dst;
    for (out, made) in outs.iter_mut().zip(&made) {
        for (j, v) in bounds.iter().enumerate() {
            let [z, y, x] = v.map(|c| c as usize);
            if left((z * ny + y) * nx + x) {
                put(&mut out.dst, [part.lo[0] + z, part.lo[1] + y, part.lo[2] + x], made.at(j));
            }
        }
    }
}

/// A code back to its number.
fn number(code: u32) -> f32 {
    f32::from_bits(if code >= 1 << 31 { code ^ (1 << 31) } else { !code })
}

fn put(dst: &mut AnyViewMut, at: [usize; 3], value: f64) {
    fn set<T: Voxel>(d: &mut ViewMut<T>, at: [usize; 3], value: f64) {
        d.set(at, T::from_f64(value));
    }
    crate::with_view!(AnyViewMut, dst, d => set(d, at, value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_in_the_order_of_numbers_and_come_back() {
        let code = |v: f32| {
            let bits = v.to_bits();
            if bits >> 31 == 1 { !bits } else { bits | 1 << 31 }
        };
        let list = [f32::NEG_INFINITY, f32::MIN, -1.0, -1e-45, -0.0, 0.0, 1e-45, 1e-30, 1.0, f32::MAX, f32::INFINITY];
        for pair in list.windows(2) {
            assert!(code(pair[0]) < code(pair[1]));
        }
        list.iter().for_each(|v| assert_eq!(number(code(*v)).to_bits(), v.to_bits()));
    }
}
