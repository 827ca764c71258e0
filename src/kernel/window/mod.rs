//! Box-window statistics and the openness estimators made from them (papers A and E), fused in one pass.
//!
//! Tiles as wide as possible in x go through z, then y, then x ([`plan`]); the raw planes are the ring, so nothing but
//! a batch of reduced planes is kept, and the estimators consume rows while they are in L1.
//! Integers use exact sums ([`int`]), floats sums and (sum, M2) merges in f64 in an order that depends on the window and its
//! place in the volume alone ([`float`], [`parts`]). [`reference`] says in a page what must come out.

use super::Context;
use crate::grid::{AnyView, AnyViewMut, DType, Shape, View, Voxel};
use crate::stage::{WindowChannel, WindowParams};

mod along;
mod beta;
mod emit;
mod estimate;
mod exact;
mod extremes;
mod far;
mod finish;
pub mod finish_floats;
mod float;
mod float_estimate;
mod float_extremes;
mod float_power;
mod float_spread;
mod int;
mod int_extremes;
mod lines;
#[doc(hidden)]
pub mod math;
mod merge;
mod moments;
mod openness;
mod parts;
mod plan;
#[doc(hidden)]
pub mod reference;
mod running;
mod slide;
#[cfg(test)]
mod tests;

use emit::Emit;
pub use estimate::Width;
#[doc(hidden)]
pub use float_power::power_row;
use int::Dispatch;
use plan::Job;
pub use plan::Needs;

/// One requested result. Its element type must be: for `Min` and `Max` the input's type where the affine is the identity,
/// else `src.dtype().result()`; for everything else `src.dtype().result()`. An `Openness` may also ask for `u8` where
/// `src` is u8, i8, u16, i16 or f32: round half even of 255 O, within half a code + 2e-4.
pub struct WindowOut<'a> {
    pub channel: WindowChannel,
    pub dst: AnyViewMut<'a>,
}

/// Where the output box lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// Its first voxel in `src`.
    pub at: [usize; 3],
    /// Its first voxel in the volume, modulo 8: sums of floats are put together in blocks that start at multiples of 8 of
    /// the volume, so that bricks never show.
    pub phase: [usize; 3],
}

impl Place {
    /// `voxel` is the box's first voxel in the volume.
    pub fn new(at: [usize; 3], voxel: [i64; 3]) -> Place {
        Place { at, phase: voxel.map(|v| v.rem_euclid(parts::BLOCK as i64) as usize) }
    }

    /// For a `src` that starts where the volume does.
    pub fn whole(at: [usize; 3]) -> Place {
        Place::new(at, at.map(|v| v as i64))
    }
}

/// Computes every channel of `outs` for the box of `src` at `place`; all outputs have the same shape.
///
/// Missing voxels (NaN, or `params.missing` for integers) do not count. Where the centre is missing, float outputs are
/// NaN and integer outputs 0. An infinity changes only the windows that hold it: minimum, maximum and mean follow IEEE,
/// variance and std are NaN, the second moment is +inf. Openness with infinities in a window that is not constant: 1 at
/// a centre of +inf, 0 at -inf; at a finite centre the limit of the formula as the infinity is approached, where that hangs on
/// nothing else: `cdf_power` 0 with +inf and 1 with -inf in the window, `chebyshev` 0 and `chebyshev_literal` 1 with +inf; NaN for
/// the other methods that use the spread, and where both infinities meet. `solid_low` swaps the signs.
///
/// Panics if extents or types disagree, or if a window could hold 2^31 voxels.
pub fn window(src: AnyView, params: &WindowParams, place: Place, outs: &mut [WindowOut], cx: &mut Context) {
    let Some(dst) = outs.first().map(|o| o.dst.shape()) else { return };
    check(src, params, place.at, dst, outs);
    if dst.contains(&0) {
        return;
    }
    match src {
        AnyView::U8(v) => integers::<u8, u8>(v, 0, params, place, dst, outs, cx),
        AnyView::I8(v) => integers::<i8, u8>(v, 1 << 7, params, place, dst, outs, cx),
        AnyView::U16(v) => integers::<u16, u16>(v, 0, params, place, dst, outs, cx),
        AnyView::I16(v) => integers::<i16, u16>(v, 1 << 15, params, place, dst, outs, cx),
        AnyView::U32(v) => integers::<u32, u32>(v, 0, params, place, dst, outs, cx),
        AnyView::I32(v) => integers::<i32, u32>(v, 1 << 31, params, place, dst, outs, cx),
        AnyView::F32(v) => {
            let channels = outs.iter().map(|o| o.channel);
            let needs = Needs::of(channels, true);
            let job = Job::new(v.shape, dst, place, params, needs, plan::batch_bytes(DType::F32, needs));
            let bytes = cx.scratch.take(float::bytes::<f32>(&job));
            float::run(v, params, place, dst, outs, cx.level, bytes)
        }
        AnyView::F64(v) => far::run(v, params, place, dst, outs, cx),
    }
}

/// Bytes of scratch that [`window`] takes at most.
pub fn scratch_bytes(dtype: DType, src: Shape, dst: Shape, params: &WindowParams, channels: &[WindowChannel]) -> usize {
    if dst.contains(&0) || channels.is_empty() {
        return 0;
    }
    let needs = Needs::of(channels.iter().copied(), dtype.is_float());
    // No layout depends on where the box lies.
    let job = Job::new(src, dst, Place::whole([0; 3]), params, needs, plan::batch_bytes(dtype, needs));
    let masked = params.missing.is_some();
    match dtype {
        DType::U8 | DType::I8 => int_bytes::<u8>(&job, masked),
        DType::U16 | DType::I16 => int_bytes::<u16>(&job, masked),
        DType::U32 | DType::I32 => int_bytes::<u32>(&job, masked),
        DType::F32 => float::bytes::<f32>(&job),
        DType::F64 => far::bytes(src, dst, params, channels.iter().copied()),
    }
}

fn int_bytes<C: Dispatch>(job: &Job, masked: bool) -> usize {
    Emit::bytes(plan::ROWS * job.out_pitch(), job.tile[1]) + C::bytes(job, masked)
}

fn check(src: AnyView, params: &WindowParams, at: [usize; 3], dst: Shape, outs: &[WindowOut]) {
    let shape = src.shape();
    assert!((0..3).all(|a| at[a] + dst[a] <= shape[a]), "output {dst:?} at {at:?} sticks out of {shape:?}");
    for out in outs {
        assert_eq!(out.dst.shape(), dst, "outputs of one shape");
        let (dtype, given) = (src.dtype(), out.dst.dtype());
        let fits = match out.channel {
            WindowChannel::Min | WindowChannel::Max if params.affine.is_identity() => given == dtype,
            WindowChannel::Openness(..) => {
                given == dtype.result() || given == DType::U8 && dtype.result() == DType::F32
            }
            // What pools levels takes means unrounded.
            WindowChannel::Mean => given == dtype.result() || given == DType::F64,
            _ => given == dtype.result(),
        };
        assert!(fits, "{:?} of {dtype} is not written as {given}", out.channel);
    }
}

/// Integer volumes of type `S` as unsigned codes `C`: stored bits XOR `flip`.
fn integers<S: Voxel, C: Dispatch>(
    src: View<S>,
    flip: C,
    params: &WindowParams,
    place: Place,
    dst: Shape,
    outs: &mut [WindowOut],
    cx: &mut Context,
) {
    let needs = Needs::of(outs.iter().map(|o| o.channel), false);
    let job = Job::new(src.shape, dst, place, params, needs, plan::batch_bytes(S::DTYPE, needs));
    // A marker that the type cannot hold marks nothing.
    let missing = params.missing.map(|m| m as f64).filter(|m| {
        let (least, most) = S::DTYPE.range();
        (least..=most).contains(m)
    });
    let missing = missing.map(|m| code_of::<C>(m + flip.u32() as f64));
    let mut bytes = cx.scratch.take(int_bytes::<C>(&job, missing.is_some()));
    let mut emit = Emit::new(outs, params, cx.level, [plan::ROWS * job.out_pitch(), job.tile[1]], &mut bytes);
    let setup = int::Setup { job: &job, level: cx.level, flip, missing };
    let view = View { data: plan::bits::<C, S>(src.data), shape: src.shape, plane: src.plane, row: src.row };
    C::run(view, &setup, &mut emit, bytes);
}

fn code_of<C: Dispatch>(code: f64) -> C {
    C::from_f64(code)
}
