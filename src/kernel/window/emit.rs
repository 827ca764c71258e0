//! Writes finished rows to the requested channels.

use super::estimate::{self, Acc, Code, Polarity, RowSum, Spread, Width};
use super::int::Setup;
use super::openness::Target;
use super::plan::cut;
use super::{WindowOut, exact, finish, openness};
use crate::brick::scratch::padded;
use crate::grid::{Affine, AnyViewMut, ViewMut, Voxel};
use crate::kernel::simd::Level;
use crate::stage::{Method, Ties, WindowChannel, WindowParams};

/// Finished windows of consecutive rows of integer codes. Row `k` of the centres `v` (stored bits) starts at `k * v_pitch`,
/// of the counts at `k * n_pitch`, of all others at `k * pitch`.
#[derive(Clone, Copy)]
pub struct IntRows<'a, T, X1, X2> {
    pub v: &'a [T],
    pub v_pitch: usize,
    pub lo: &'a [T],
    pub hi: &'a [T],
    pub s1: &'a [X1],
    pub s2: &'a [X2],
    pub n: &'a [u32],
    /// 1 / n, rounded; anything unless the emitter [`Emit::divides`].
    pub inverse: &'a [f64],
    pub n_pitch: usize,
    pub pitch: usize,
    pub rows: usize,
    pub len: usize,
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
    /// `open` is the most values of openness that are made together, `width` the most voxels in a row.
    pub fn new(
        outs: &'a mut [WindowOut<'b>],
        params: &'a WindowParams,
        level: Level,
        [open, width]: [usize; 2],
        bytes: &mut &'a mut [u8],
    ) -> Self {
        let open = cut(bytes, open);
        let [mean, variance, numerator] = std::array::from_fn(|_| cut(bytes, width));
        Emit { outs, params, level, open, mean, variance, numerator }
    }

    pub fn bytes(open: usize, width: usize) -> usize {
        padded::<f32>(open) + 3 * padded::<f64>(width)
    }

    /// Whether a channel divides by counts, and [`IntRow::inverse`] is read.
    pub fn divides(&self) -> bool {
        use WindowChannel::{Mean, Moment2, Std, Variance};
        self.wants(|c| matches!(c, Mean | Variance | Std | Moment2))
    }

    fn wants(&self, f: impl Fn(WindowChannel) -> bool) -> bool {
        self.outs.iter().any(|o| f(o.channel))
    }

    /// Writes the rows that start at output voxel `at`.
    pub fn int_rows<T: Code, X1: RowSum, X2: Acc>(
        &mut self,
        setup: &Setup<T>,
        rows: IntRows<T, X1, X2>,
        at: [usize; 3],
    ) {
        let (level, affine) = (self.level, self.params.affine);
        let part = Part { at, rows: rows.rows, len: rows.len, pitch: rows.pitch };
        for i in 0..self.outs.len() {
            let channel = self.outs[i].channel;
            match channel {
                WindowChannel::Openness(method, ties) => self.int_openness(setup, &rows, &part, i, (method, ties)),
                WindowChannel::Min | WindowChannel::Max => {
                    let lower = (channel == WindowChannel::Min) == (affine.slope > 0.0);
                    let codes = if lower { rows.lo } else { rows.hi };
                    put_codes(level, &mut self.outs[i].dst, &part, codes, setup.flip, affine);
                }
                _ if T::TOP == u32::MAX => self.long_moments(setup, &rows, &part, i),
                _ => {
                    let offset = setup.flip.u32() as f64;
                    match &mut self.outs[i].dst {
                        AnyViewMut::F32(d) => {
                            finish::moment_rows(level, channel, &rows, offset, affine, part.target(d))
                        }
                        AnyViewMut::F64(d) => {
                            finish::moment_rows(level, channel, &rows, offset, affine, part.target(d))
                        }
                        other => panic!("{channel:?} is not written as {}", other.dtype()),
                    }
                }
            }
            if let Some(missing) = setup.missing {
                for k in 0..rows.rows {
                    let gone = |x: usize| rows.v[k * rows.v_pitch + x].code(setup.flip) == missing;
                    repair(&mut self.outs[i].dst, part.start(k), rows.len, gone);
                }
            }
        }
    }

    /// Writes mean, variance, std or second moment of 32-bit codes as channel `i`, row by row.
    fn long_moments<T: Code, X1: RowSum, X2: Acc>(
        &mut self,
        setup: &Setup<T>,
        rows: &IntRows<T, X1, X2>,
        part: &Part,
        i: usize,
    ) {
        let (level, len, affine) = (self.level, rows.len, self.params.affine);
        let (offset, channel) = (setup.flip.u32(), self.outs[i].channel);
        let exact = rows.most as u128 * (T::TOP as u128) < 1 << 52;
        for k in 0..rows.rows {
            let (row, counted) = (part.row(k), k * rows.n_pitch..k * rows.n_pitch + len);
            let (s1, n, inverse) = (&rows.s1[row.clone()], &rows.n[counted.clone()], &rows.inverse[counted]);
            let dst = &mut self.outs[i].dst;
            if channel != WindowChannel::Mean {
                let s2 = &rows.s2[row];
                if channel == WindowChannel::Moment2 && affine.is_identity() {
                    match dst {
                        AnyViewMut::F64(d) => exact::moment2_row(level, s1, s2, n, offset, part.line(d, k)),
                        AnyViewMut::F32(d) => exact::moment2_row(level, s1, s2, n, offset, part.line(d, k)),
                        other => panic!("{channel:?} is not written as {}", other.dtype()),
                    }
                    continue;
                }
                exact::variance_row(level, s1, s2, n, &mut self.variance[..len]);
            }
            if matches!(channel, WindowChannel::Mean | WindowChannel::Moment2) {
                estimate::mean_row(level, s1, n, inverse, offset as f64, exact, &mut self.mean[..len]);
            }
            put_moment(level, channel, dst, part.start(k), len, self.mean, self.variance, affine);
        }
    }

    /// Writes openness as channel `i`.
    fn int_openness<T: Code, X1: RowSum, X2: Acc>(
        &mut self,
        setup: &Setup<T>,
        rows: &IntRows<T, X1, X2>,
        part: &Part,
        i: usize,
        (method, ties): (Method, Ties),
    ) {
        let (level, flip, polarity) = (self.level, setup.flip, polarity(self.params, ties));
        let &IntRows { v, v_pitch, lo, hi, s1, s2, n, n_pitch, pitch, most, len, width, .. } = rows;
        let windows = openness::Rows { v, v_pitch, flip, s1, n, n_pitch, pitch, most, rows: rows.rows, len };
        let squares = openness::Squares { s2, width };
        macro_rules! fill {
            ($to:expr) => {
                match estimator(method) {
                    Estimator::Power => openness::cdf_power_rows(level, &windows, lo, hi, polarity, $to),
                    Estimator::Spread(kind) => openness::spread_rows(level, kind, &windows, &squares, polarity, $to),
                    Estimator::Beta => unreachable!("has gone row by row"),
                }
            };
        }
        let dst = &mut self.outs[i].dst;
        if let Estimator::Beta = estimator(method) {
            for k in 0..rows.rows {
                let (row, v, n) = (part.row(k), &v[k * v_pitch..][..len], &n[k * n_pitch..][..len]);
                let (lo, hi, s1, s2) = (&lo[row.clone()], &hi[row.clone()], &s1[row.clone()], &s2[row]);
                let numerator = &mut self.numerator[..len];
                estimate::numerator_row(level, s1, s2, n, width, numerator);
                let fill =
                    |out: &mut [f32]| estimate::beta_row(level, v, flip, lo, hi, s1, n, numerator, polarity, out);
                put_openness(level, dst, part.start(k), len, self.open, fill);
            }
            return;
        }
        match dst {
            AnyViewMut::F32(d) => fill!(&mut part.target(d)),
            AnyViewMut::U8(d) => fill!(&mut part.target(d)),
            AnyViewMut::F64(d) => {
                fill!(&mut Target { data: self.open, pitch });
                for k in 0..rows.rows {
                    let row = &self.open[part.row(k)];
                    part.line(d, k).iter_mut().zip(row).for_each(|(d, o)| *d = *o as f64);
                }
            }
            other => panic!("openness is not written as {}", other.dtype()),
        }
    }
}

/// Rows of an output from voxel `at` on, and how they lie in buffers.
struct Part {
    at: [usize; 3],
    rows: usize,
    len: usize,
    pitch: usize,
}

impl Part {
    /// Row `k` in buffers.
    fn row(&self, k: usize) -> std::ops::Range<usize> {
        k * self.pitch..k * self.pitch + self.len
    }

    /// First voxel of row `k`.
    fn start(&self, k: usize) -> [usize; 3] {
        [self.at[0], self.at[1] + k, self.at[2]]
    }

    /// Row `k` of the output.
    fn line<'a, O>(&self, d: &'a mut ViewMut<O>, k: usize) -> &'a mut [O] {
        &mut d.row_at(self.at[0], self.at[1] + k)[self.at[2]..self.at[2] + self.len]
    }

    /// All of them.
    fn target<'a, O>(&self, d: &'a mut ViewMut<O>) -> Target<'a, O> {
        let start = self.at[0] * d.plane + self.at[1] * d.row + self.at[2];
        let end = start + (self.rows - 1) * d.row + self.len;
        Target { data: &mut d.data[start..end], pitch: d.row }
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
fn put_codes<T: Code>(level: Level, dst: &mut AnyViewMut, part: &Part, codes: &[T], flip: T, affine: Affine) {
    let offset = flip.u32() as f64;
    macro_rules! uncode {
        ($d:ident) => {{
            let Target { data, pitch } = part.target($d);
            let to = Target { data: bits_mut(data), pitch };
            uncode_rows(level, codes, part.pitch, flip, to, part.rows, part.len)
        }};
    }
    match dst {
        AnyViewMut::F32(d) if !affine.is_identity() => {
            (0..part.rows).for_each(|k| scale_row(level, &codes[part.row(k)], offset, affine, part.line(d, k)));
        }
        AnyViewMut::F64(d) if !affine.is_identity() => {
            (0..part.rows).for_each(|k| scale_row(level, &codes[part.row(k)], offset, affine, part.line(d, k)));
        }
        AnyViewMut::U8(d) => uncode!(d),
        AnyViewMut::I8(d) => uncode!(d),
        AnyViewMut::U16(d) => uncode!(d),
        AnyViewMut::I16(d) => uncode!(d),
        AnyViewMut::U32(d) => uncode!(d),
        AnyViewMut::I32(d) => uncode!(d),
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
    fn uncode_rows['a, T: Code](
        codes: &[T], pitch: usize, flip: T, to: Target<'a, T>, rows: usize, len: usize
    ) -> () = uncode_inner;
}

#[inline(always)]
fn uncode_inner<T: Code>(codes: &[T], pitch: usize, flip: T, to: Target<T>, rows: usize, len: usize) {
    for k in 0..rows {
        for (o, c) in to.data[k * to.pitch..][..len].iter_mut().zip(&codes[k * pitch..][..len]) {
            *o = c.code(flip);
        }
    }
}

/// The same numbers as another type of the same size. Panics if the sizes differ.
pub fn bits_mut<T: bytemuck::Pod, U: Voxel>(row: &mut [U]) -> &mut [T] {
    assert_eq!(size_of::<T>(), size_of::<U>(), "types of one size");
    bytemuck::cast_slice_mut(row)
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
