//! Windows of f32 on their way back: from the device's codes and cells to results, and those that f32 pairs cannot hold by
//! the CPU kernel.

use super::engine::GpuError;
use super::pairs::Cell;
use super::passes::{self, Job, Part, Quantity, result_bytes};
use super::windows::cast;
use crate::brick::Voxels;
use crate::grid::{AnyView, AnyViewMut, Region, View, Voxel};
use crate::kernel::Context;
use crate::kernel::window::finish_floats::{Moments, finish_floats};
use crate::kernel::window::{self, Place, WindowOut};
use crate::stage::WindowParams;

/// Between these magnitudes of a window's largest voxel neither sums nor squares leave the normal numbers of f32.
const LARGE: f32 = (1u64 << 40) as f32;
const SMALL: f32 = 1.0 / (1u64 << 30) as f32;

/// The results of a part.
pub(super) struct FloatPart<'a> {
    job: &'a Job,
    part: &'a Part,
    /// Pairs of codes.
    order: &'a [[u32; 2]],
    /// Cells, or nothing where no channel needs them.
    cells: &'a [u32],
    words: usize,
}

impl<'a> FloatPart<'a> {
    pub fn new(job: &'a Job, part: &'a Part, bytes: &'a [u8]) -> Result<FloatPart<'a>, GpuError> {
        let mut out = FloatPart { job, part, order: &[], cells: &[], words: 0 };
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

    /// Writes the part's voxels.
    pub fn finish(
        &self,
        src: View<f32>,
        params: &WindowParams,
        outs: &mut [WindowOut],
        cx: &mut Context,
    ) -> Result<(), GpuError> {
        finish_floats(src, params, self.job.at, outs, self.part.lo, self.part.dst, |i| self.window(i), cx);
        if let Some(bounds) = self.left_box() {
            self.redo(src, params, outs, &bounds, cx);
        }
        Ok(())
    }

    /// The least box of the part that holds every window that is left to the CPU.
    fn left_box(&self) -> Option<Region> {
        let left = Region::whole(self.part.dst).iter().enumerate().filter(|(i, _)| self.left(*i)).map(|(_, v)| v);
        left.fold(None, |held: Option<Region>, v| {
            let one = Region::new(v, v.map(|c| c + 1));
            let least = |h: Region| std::array::from_fn(|a| h.lo[a].min(one.lo[a]));
            let most = |h: Region| std::array::from_fn(|a| h.hi[a].max(one.hi[a]));
            Some(held.map_or(one, |h| Region::new(least(h), most(h))))
        })
    }

    /// Makes a box of the part on the CPU, which gives the same wherever a call starts, and keeps what is left to it.
    fn redo(&self, src: View<f32>, params: &WindowParams, outs: &mut [WindowOut], bounds: &Region, cx: &mut Context) {
        let first = bounds.lo.map(|v| v as usize);
        let shape = bounds.shape();
        let lo: [usize; 3] = std::array::from_fn(|a| self.part.lo[a] + first[a]);
        let at = std::array::from_fn(|a| self.job.at[a] + lo[a]);
        let voxel = std::array::from_fn(|a| self.job.place[a] + lo[a] as i64);
        let mut made: Vec<Voxels> = outs.iter().map(|o| Voxels::zeroed(o.dst.dtype(), bounds.voxels())).collect();
        let mut again: Vec<WindowOut> = (outs.iter().zip(&mut made))
            .map(|(o, v)| WindowOut { channel: o.channel, dst: v.view_mut(shape) })
            .collect();
        window::window(AnyView::F32(src), params, Place::new(at, voxel), &mut again, cx);
        let [_, ny, nx] = self.part.dst;
        for (out, made) in outs.iter_mut().zip(&made) {
            for (j, v) in bounds.iter().enumerate() {
                let [z, y, x] = v.map(|c| c as usize);
                if self.left((z * ny + y) * nx + x) {
                    let to = [self.part.lo[0] + z, self.part.lo[1] + y, self.part.lo[2] + x];
                    put(&mut out.dst, to, made.at(j));
                }
            }
        }
    }
}

/// A code back to its number.
fn number(code: u32) -> f32 {
    f32::from_bits(if code >= 1 << 31 { code ^ (1 << 31) } else { !code })
}

fn put(dst: &mut AnyViewMut, at: [usize; 3], value: f64) {
    fn set<T: Voxel>(d: &mut crate::grid::ViewMut<T>, at: [usize; 3], value: f64) {
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
