//! Writes finished rows to the requested channels.

use super::estimate::{self, Acc, Code, Polarity, RowSum, Spread, Width};
use super::int::Setup;
use super::plan::{Plain, cut, padded};
use super::{WindowOut, exact, openness};
use crate::grid::{Affine, AnyViewMut, Voxel};
use crate::kernel::simd::Level;
use crate::stage::{Method, Ties, WindowChannel, WindowParams};

/// Finished windows of one row of integer codes. `v` holds stored bits.
pub struct IntRow<'a, T, X1, X2> {
    pub v: &'a [T],
    pub lo: &'a [T],
    pub hi: &'a [T],
    pub s1: &'a [X1],
    pub s2: &'a [X2],
    pub n: &'a [u32],
    /// 1 / n, rounded; anything unless the emitter [`Emit::divides`].
    pub inverse: &'a [f64],
    /// Most voxels in a window.
    pub most: u64,
    pub width: Width,
}

/// The requested channels and row buffers.
pub struct Emit<'a, 'b> {
    pub outs: &'a mut [WindowOut<'b>],
    pub params: &'a WindowParams,
    pub level: Level,
    /// Openness on its way to another type.
    pub open: &'a mut [f32],
    /// Unscaled mean, variance and, for integers, its numerator.
    pub mean: &'a mut [f64],
    pub variance: &'a mut [f64],
    pub numerator: &'a mut [f64],
}

impl<'a, 'b> Emit<'a, 'b> {
    /// `width` is the most voxels in a row.
    pub fn new(
        outs: &'a mut [WindowOut<'b>],
        params: &'a WindowParams,
        level: Level,
        width: usize,
        bytes: &mut &'a mut [u8],
    ) -> Self {
        let open = cut(bytes, width);
        let [mean, variance, numerator] = std::array::from_fn(|_| cut(bytes, width));
        Emit { outs, params, level, open, mean, variance, numerator }
    }

    pub fn bytes(width: usize) -> usize {
        padded::<f32>(width) + 3 * padded::<f64>(width)
    }

    /// Whether a channel divides by counts, and [`IntRow::inverse`] is read.
    pub fn divides(&self) -> bool {
        use WindowChannel::{Mean, Moment2, Std, Variance};
        self.wants(|c| matches!(c, Mean | Variance | Std | Moment2))
    }

    fn wants(&self, f: impl Fn(WindowChannel) -> bool) -> bool {
        self.outs.iter().any(|o| f(o.channel))
    }

    /// Writes the row that starts at output voxel `at`.
    pub fn int_row<T: Code + Plain, X1: RowSum, X2: Acc>(
        &mut self,
        setup: &Setup<T>,
        row: IntRow<T, X1, X2>,
        at: [usize; 3],
    ) {
        let (level, len) = (self.level, row.v.len());
        let offset = setup.flip.u32() as f64;
        if setup.job.needs.variance {
            estimate::numerator_row(level, row.s1, row.s2, row.n, row.width, &mut self.numerator[..len]);
            if self.wants(|c| matches!(c, WindowChannel::Variance | WindowChannel::Std | WindowChannel::Moment2)) {
                if T::TOP == u32::MAX {
                    exact::variance_row(level, row.s1, row.s2, row.n, &mut self.variance[..len]);
                } else {
                    estimate::variance_row(level, &self.numerator[..len], row.inverse, &mut self.variance[..len]);
                }
            }
        }
        if self.wants(|c| matches!(c, WindowChannel::Mean | WindowChannel::Moment2)) {
            let exact = row.most as u128 * (T::TOP as u128) < 1 << 52;
            estimate::mean_row(level, row.s1, row.n, row.inverse, offset, exact, &mut self.mean[..len]);
        }
        let affine = self.params.affine;
        for i in 0..self.outs.len() {
            let channel = self.outs[i].channel;
            match channel {
                WindowChannel::Openness(method, ties) => {
                    let polarity = polarity(self.params, ties);
                    let (v, flip, n) = (row.v, setup.flip, row.n);
                    let windows = openness::Row { v, flip, s1: row.s1, n, most: row.most };
                    let numerator = &self.numerator[..len.min(self.numerator.len())];
                    let fill = |out: &mut [f32]| match estimator(method) {
                        Estimator::Power => openness::cdf_power_row(level, &windows, row.lo, row.hi, polarity, out),
                        Estimator::Beta => {
                            estimate::beta_row(level, v, flip, row.lo, row.hi, row.s1, n, numerator, polarity, out)
                        }
                        Estimator::Spread(kind) => {
                            openness::spread_row(level, kind, &windows, numerator, polarity, out)
                        }
                    };
                    put_openness(level, &mut self.outs[i].dst, at, len, self.open, fill);
                }
                WindowChannel::Min | WindowChannel::Max => {
                    let lower = (channel == WindowChannel::Min) == (affine.slope > 0.0);
                    let codes = if lower { row.lo } else { row.hi };
                    put_codes(level, &mut self.outs[i].dst, at, &codes[..len], setup.flip, affine);
                }
                WindowChannel::Moment2 if T::TOP == u32::MAX && affine.is_identity() => {
                    let (x, offset) = (at[2], setup.flip.u32());
                    match &mut self.outs[i].dst {
                        AnyViewMut::F64(d) => {
                            let out = &mut d.row_at(at[0], at[1])[x..x + len];
                            exact::moment2_row(level, row.s1, row.s2, row.n, offset, out);
                        }
                        AnyViewMut::F32(d) => {
                            let out = &mut d.row_at(at[0], at[1])[x..x + len];
                            exact::moment2_row(level, row.s1, row.s2, row.n, offset, out);
                        }
                        other => panic!("{channel:?} is not written as {}", other.dtype()),
                    }
                }
                _ => put_moment(level, channel, &mut self.outs[i].dst, at, len, self.mean, self.variance, affine),
            }
            if let Some(missing) = setup.missing {
                let gone = |x: usize| row.v[x].code(setup.flip) == missing;
                repair(&mut self.outs[i].dst, at, len, gone);
            }
        }
    }
}

pub fn polarity(params: &WindowParams, ties: Ties) -> Polarity {
    let constant = match ties {
        Ties::Le => 1.0,
        Ties::Mid => 0.5,
    };
    Polarity { flipped: params.flipped(), constant }
}

/// What a method is computed by.
pub enum Estimator {
    Power,
    Beta,
    Spread(Spread),
}

pub fn estimator(method: Method) -> Estimator {
    match method {
        Method::CdfPower => Estimator::Power,
        Method::Beta => Estimator::Beta,
        Method::GaussianCdf => Estimator::Spread(Spread::Gaussian),
        Method::Chebyshev => Estimator::Spread(Spread::Chebyshev),
        Method::ChebyshevLiteral => Estimator::Spread(Spread::Literal),
        Method::Exact | Method::Levels | Method::Moments4 => unreachable!("refused when the needs were worked out"),
    }
}

/// Lets `fill` write a row of openness, and converts it to the output's type.
pub fn put_openness(
    level: Level,
    dst: &mut AnyViewMut,
    [z, y, x]: [usize; 3],
    len: usize,
    buffer: &mut [f32],
    fill: impl FnOnce(&mut [f32]),
) {
    match dst {
        AnyViewMut::F32(d) => fill(&mut d.row_at(z, y)[x..x + len]),
        AnyViewMut::F64(d) => {
            fill(&mut buffer[..len]);
            for (d, o) in d.row_at(z, y)[x..x + len].iter_mut().zip(buffer) {
                *d = *o as f64;
            }
        }
        AnyViewMut::U8(d) => {
            fill(&mut buffer[..len]);
            estimate::quantise_row(level, &buffer[..len], &mut d.row_at(z, y)[x..x + len]);
        }
        other => panic!("openness is not written as {}", other.dtype()),
    }
}

/// Writes mean, variance, std or second moment, scaled and rounded once.
#[allow(clippy::too_many_arguments)]
pub fn put_moment(
    level: Level,
    channel: WindowChannel,
    dst: &mut AnyViewMut,
    [z, y, x]: [usize; 3],
    len: usize,
    mean: &[f64],
    variance: &[f64],
    affine: Affine,
) {
    match dst {
        AnyViewMut::F32(d) => moment_row(level, channel, mean, variance, affine, &mut d.row_at(z, y)[x..x + len]),
        AnyViewMut::F64(d) => moment_row(level, channel, mean, variance, affine, &mut d.row_at(z, y)[x..x + len]),
        other => panic!("{channel:?} is not written as {}", other.dtype()),
    }
}

crate::multiversion! {
    fn moment_row[O: Voxel](channel: WindowChannel, mean: &[f64], variance: &[f64], affine: Affine, out: &mut [O]) -> () = moment_inner;
}

#[inline(always)]
fn moment_inner<O: Voxel>(channel: WindowChannel, mean: &[f64], variance: &[f64], affine: Affine, out: &mut [O]) {
    let (a, b) = (affine.slope, affine.intercept);
    let (mean, variance) = (&mean[..out.len()], &variance[..out.len()]);
    match channel {
        WindowChannel::Mean => {
            for (o, m) in out.iter_mut().zip(mean) {
                *o = O::from_f64(a * m + b);
            }
        }
        WindowChannel::Variance => {
            for (o, v) in out.iter_mut().zip(variance) {
                *o = O::from_f64(a * a * v);
            }
        }
        WindowChannel::Std => {
            for (o, v) in out.iter_mut().zip(variance) {
                *o = O::from_f64(a.abs() * v.sqrt());
            }
        }
        _ => {
            for ((o, v), m) in out.iter_mut().zip(variance).zip(mean) {
                let m = a * m + b;
                let square = a * a * v + m * m;
                // An infinity makes the variance NaN, but not the mean square.
                *o = O::from_f64(if m.is_finite() { square } else { f64::INFINITY });
            }
        }
    }
}

/// Writes extremes given as codes: stored values where nothing scales them.
fn put_codes<T: Code + Plain>(
    level: Level,
    dst: &mut AnyViewMut,
    [z, y, x]: [usize; 3],
    codes: &[T],
    flip: T,
    affine: Affine,
) {
    let offset = flip.u32() as f64;
    let end = x + codes.len();
    match dst {
        AnyViewMut::F32(d) if !affine.is_identity() => {
            scale_row(level, codes, offset, affine, &mut d.row_at(z, y)[x..end]);
        }
        AnyViewMut::F64(d) if !affine.is_identity() => {
            scale_row(level, codes, offset, affine, &mut d.row_at(z, y)[x..end]);
        }
        AnyViewMut::U8(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        AnyViewMut::I8(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        AnyViewMut::U16(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        AnyViewMut::I16(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        AnyViewMut::U32(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        AnyViewMut::I32(d) => uncode_row(level, codes, flip, bits_mut(&mut d.row_at(z, y)[x..end])),
        other => panic!("extremes are not written as {}", other.dtype()),
    }
}

crate::multiversion! {
    fn scale_row[T: Code, O: Voxel](codes: &[T], offset: f64, affine: Affine, out: &mut [O]) -> () = scale_inner;
}

#[inline(always)]
fn scale_inner<T: Code, O: Voxel>(codes: &[T], offset: f64, affine: Affine, out: &mut [O]) {
    for (o, c) in out.iter_mut().zip(codes) {
        *o = O::from_f64(affine.slope * (c.u32() as f64 - offset) + affine.intercept);
    }
}

crate::multiversion! {
    fn uncode_row[T: Code](codes: &[T], flip: T, out: &mut [T]) -> () = uncode_inner;
}

#[inline(always)]
fn uncode_inner<T: Code>(codes: &[T], flip: T, out: &mut [T]) {
    for (o, c) in out.iter_mut().zip(codes) {
        *o = c.code(flip);
    }
}

/// The same numbers as another type of the same size. Panics if the sizes differ.
pub fn bits_mut<T: Plain, U: Voxel>(row: &mut [U]) -> &mut [T] {
    assert_eq!(size_of::<T>(), size_of::<U>(), "types of one size");
    // SAFETY: equal size (asserted) and alignment (primitive numbers), and every bit pattern is a value of both.
    unsafe { std::slice::from_raw_parts_mut(row.as_mut_ptr().cast(), row.len()) }
}

/// NaN (0 where the type has none) at the voxels of a row that `gone` names.
pub fn repair(dst: &mut AnyViewMut, [z, y, x]: [usize; 3], len: usize, gone: impl Fn(usize) -> bool) {
    fn mark<O: Voxel>(row: &mut [O], gone: impl Fn(usize) -> bool) {
        let nothing = O::from_f64(f64::NAN);
        for (i, o) in row.iter_mut().enumerate() {
            if gone(i) {
                *o = nothing;
            }
        }
    }
    crate::with_view!(AnyViewMut, dst, d => mark(&mut d.row_at(z, y)[x..x + len], gone))
}
