//! The second half of the integer kernel: from exact window sums that another device made to results, by the same row
//! functions, so that the bits are the same.

use super::emit::{Emit, IntRow};
use super::estimate::{self, Acc, Code, RowSum, Width};
use super::int::{Dispatch, Setup};
use super::plan::{self, Job, Needs, Plain, cut, padded};
use super::{Place, WindowOut, check};
use crate::grid::{AnyView, Shape, View, Voxel};
use crate::kernel::Context;
use crate::stage::WindowParams;

/// One sum per window of a box, dense, x fastest.
#[derive(Debug, Clone, Copy)]
pub enum Sums<'a> {
    /// Not needed by any channel.
    None,
    Narrow(&'a [u32]),
    Wide(&'a [u64]),
}

/// What the windows of a part of the output box hold. Codes are unsigned: stored bits with the sign bit of i8 and i16
/// flipped.
#[derive(Debug, Clone, Copy)]
pub struct Windows<'a> {
    /// First output voxel of the part, and its extent.
    pub lo: [usize; 3],
    pub shape: Shape,
    /// Least code in the low 16 bits, greatest in the high 16; may be empty where no channel needs them.
    pub extremes: &'a [u32],
    /// Sums of codes and of their squares.
    pub s1: Sums<'a>,
    pub s2: Sums<'a>,
}

/// Writes the voxels of one part of the outputs of a call like [`super::window`] (same `src`, `params`, `at`, `outs`).
///
/// Panics where `window` does, if `src` is not u8, i8, u16 or i16, if voxels may be missing, or if a slice is too short.
pub fn finish(
    src: AnyView,
    params: &WindowParams,
    at: [usize; 3],
    outs: &mut [WindowOut],
    part: &Windows,
    cx: &mut Context,
) {
    let Some(dst) = outs.first().map(|o| o.dst.shape()) else { return };
    check(src, params, at, dst, outs);
    assert!(params.missing.is_none(), "missing voxels need counts");
    assert!((0..3).all(|a| part.lo[a] + part.shape[a] <= dst[a]), "a part outside {dst:?}");
    if part.shape.contains(&0) {
        return;
    }
    match src {
        AnyView::U8(v) => typed::<u8, u8>(v, 0, params, at, dst, outs, part, cx),
        AnyView::I8(v) => typed::<i8, u8>(v, 1 << 7, params, at, dst, outs, part, cx),
        AnyView::U16(v) => typed::<u16, u16>(v, 0, params, at, dst, outs, part, cx),
        AnyView::I16(v) => typed::<i16, u16>(v, 1 << 15, params, at, dst, outs, part, cx),
        other => panic!("sums of {} are not made elsewhere", other.dtype()),
    }
}

#[allow(clippy::too_many_arguments)]
fn typed<S: Voxel + Plain, C: Dispatch>(
    src: View<S>,
    flip: C,
    params: &WindowParams,
    at: [usize; 3],
    dst: Shape,
    outs: &mut [WindowOut],
    part: &Windows,
    cx: &mut Context,
) {
    let needs = Needs::of(outs.iter().map(|o| o.channel), false);
    // The whole call's job, not the part's: widths must not depend on how a call was cut.
    let job = Job::new(src.shape, dst, Place::whole(at), params, needs, plan::batch_bytes(S::DTYPE, needs));
    let width = job.tile[1];
    let mut bytes =
        cx.scratch.take(Emit::bytes(width) + 2 * padded::<C>(width) + 2 * padded::<u32>(width) + padded::<f64>(width));
    let mut emit = Emit::new(outs, params, cx.level, width, &mut bytes);
    let setup = Setup { job: &job, level: cx.level, flip, missing: None };
    let view = View { data: plan::bits::<C, S>(src.data), shape: src.shape, plane: src.plane, row: src.row };
    let empty: &[u32] = &[];
    match (part.s1, part.s2) {
        (Sums::None, Sums::None) => rows(view, &setup, part, empty, empty, &mut emit, bytes),
        (Sums::Narrow(a), Sums::None) => rows(view, &setup, part, a, empty, &mut emit, bytes),
        (Sums::Wide(a), Sums::None) => rows(view, &setup, part, a, empty, &mut emit, bytes),
        (Sums::Narrow(a), Sums::Narrow(b)) => rows(view, &setup, part, a, b, &mut emit, bytes),
        (Sums::Narrow(a), Sums::Wide(b)) => rows(view, &setup, part, a, b, &mut emit, bytes),
        (Sums::Wide(a), Sums::Wide(b)) => rows(view, &setup, part, a, b, &mut emit, bytes),
        other => panic!("no window needs {other:?}"),
    }
}

/// Rows of the part, in pieces as wide as the CPU's tiles.
fn rows<T: Code + Plain, X1: RowSum, X2: Acc>(
    src: View<T>,
    setup: &Setup<T>,
    part: &Windows,
    s1: &[X1],
    s2: &[X2],
    emit: &mut Emit,
    mut bytes: &mut [u8],
) {
    let job = setup.job;
    let most = job.tile[1];
    let bytes = &mut bytes;
    let (lo, hi) = (cut::<T>(bytes, most), cut::<T>(bytes, most));
    let (n, columns) = (cut::<u32>(bytes, most), cut::<u32>(bytes, most));
    let inverse = cut::<f64>(bytes, most);
    let (voxels, divides) = (job.counts().0, emit.divides());
    let width = Width::of(voxels, T::TOP);
    let [nz, ny, nx] = part.shape;
    for x in (0..nx).step_by(most) {
        let len = most.min(nx - x);
        let first = part.lo[2] + x;
        columns[..len].iter_mut().enumerate().for_each(|(i, c)| *c = job.count(2, first + i) as u32);
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let (oz, oy) = (part.lo[0] + z, part.lo[1] + y);
            let from = (z * ny + y) * nx + x;
            let section = (job.count(0, oz) * job.count(1, oy)) as u32;
            n[..len].iter_mut().zip(&*columns).for_each(|(n, c)| *n = section * c);
            if divides {
                estimate::inverse_row(setup.level, &n[..len], inverse);
            }
            if job.needs.extremes {
                for (i, e) in part.extremes[from..from + len].iter().enumerate() {
                    (lo[i], hi[i]) = (T::from_f64((e & 0xffff) as f64), T::from_f64((e >> 16) as f64));
                }
            }
            let at = job.at.map(|v| v as usize); // integers skip no output
            let start = at[2] + first;
            let row = IntRow {
                v: &src.row_at(at[0] + oz, at[1] + oy)[start..start + len],
                lo: &lo[..len],
                hi: &hi[..len],
                s1: if job.needs.mean { &s1[from..from + len] } else { &[] },
                s2: if job.needs.variance { &s2[from..from + len] } else { &[] },
                n: &n[..len],
                inverse: &inverse[..len],
                most: voxels,
                width,
            };
            emit.int_row(setup, row, [oz, oy, first]);
        }
    }
}
