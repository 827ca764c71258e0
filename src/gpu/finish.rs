//! What the device makes of sums and moments of windows, so that only results come back: channels as the shaders know them,
//! and the dispatch.

use super::passes::{self, Job, Part, Quantity};
use super::record::{Bind, Buffer, Shader};
use super::recorder::{Planes, Recorder};
use crate::grid::Affine;
use crate::kernel::window::Width;
use crate::stage::{Method, Ties, WindowChannel, WindowParams};

/// Most channels of one dispatch.
pub const MOST: usize = 16;

/// Rows of voxels of a thread; the shader's `STRIP`.
const STRIP: usize = 8;
/// Voxels of windows from which on means go through f64; the shader's `is_plain`.
const NEAREST: u64 = 1 << 27;

/// What the dispatch does; `struct Finish` of `shaders/window_finish.wgsl`, which explains the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Finish {
    pub out: [u32; 3],
    pub centre: u32,
    pub plane: u32,
    pub row: u32,
    pub cell: u32,
    pub flipped: u32,
    pub count: u32,
    pub zero: u32,
    pub threads: u32,
    pub stride: u32,
    pub channels: [u32; MOST],
}

/// The same for windows of small integers; `struct Codes` of `shaders/window_codes.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Codes {
    pub out: [u32; 2],
    pub centre: u32,
    pub plane: u32,
    pub row: u32,
    pub packing: u32,
    pub flip: u32,
    pub wide: u32,
    pub at: [u32; 3],
    pub radius: [u32; 3],
    pub size: [u32; 3],
    pub centred: u32,
    pub count: u32,
    pub stride: u32,
    pub flipped: u32,
    pub scaled: u32,
    pub threads: u32,
    pub needs: u32,
    pub whole: u32,
    pub strips: u32,
    pub share: [u32; 2],
    pub slope: [u32; 2],
    pub intercept: [u32; 2],
    pub inverse: f32,
    pub spare: [u32; 3],
    pub channels: [u32; MOST],
}

/// Channels that the device finishes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Channels {
    codes: [u32; MOST],
    count: usize,
    flipped: bool,
    affine: Affine,
}

impl Channels {
    /// `None` where a channel has no code, or values of f32 (`real`) are scaled (f64 does that on the CPU).
    pub fn of(params: &WindowParams, channels: &[WindowChannel], real: bool) -> Option<Channels> {
        if real && !params.affine.is_identity() || channels.len() > MOST {
            return None;
        }
        let mut codes = [0; MOST];
        for (to, channel) in codes.iter_mut().zip(channels) {
            *to = code(*channel)?;
        }
        Some(Channels { codes, count: channels.len(), flipped: params.flipped(), affine: params.affine })
    }

    pub fn count(&self) -> usize {
        self.count
    }

    /// Whether a channel is one of these.
    fn asks(&self, codes: &[u32]) -> bool {
        self.codes[..self.count].iter().any(|c| codes.contains(c))
    }

    /// From voxels, of which the part's source is all, and what was made of their windows to results.
    pub(super) fn record(
        &self,
        job: &Job,
        part: &Part,
        from: Bind,
        made: &[(Quantity, Buffer)],
        to: &mut Recorder,
    ) -> Planes {
        let pitch = job.pitch(part);
        let strides = [part.src[1] * pitch, pitch, 1];
        let centre: usize = (0..3).map(|a| (job.at[a] + part.lo[a] - part.from[a]) * strides[a]).sum();
        let voxels = part.dst.iter().product::<usize>();
        let planes = Planes::take(to, voxels, self.count);
        // What was not made is not looked at, and its binding may be anything.
        let of = |wanted: fn(&Quantity) -> bool| {
            let found = made.iter().find(|(q, _)| wanted(q));
            found.map_or(from, |f| f.1.into())
        };
        let source = [from, Bind::from(planes.buffer)];
        let threads = voxels as u32;
        if job.real {
            let cell = if job.needs.mean { passes::cell(job.needs.variance) } else { 0 };
            let finish = Finish {
                out: part.dst.map(|n| n as u32),
                centre: centre as u32,
                plane: strides[0] as u32,
                row: strides[1] as u32,
                cell: cell as u32,
                flipped: self.flipped as u32,
                count: self.count as u32,
                threads,
                stride: planes.stride,
                channels: self.codes,
                ..Finish::default()
            };
            let order = of(|q| *q == Quantity::Order);
            let bind = [source[0], source[1], order, of(|q| matches!(q, Quantity::Moments { .. }))];
            to.dispatch(Shader::Finish, 0, &finish, &bind, threads);
            return planes;
        }
        let wide = |squares: bool| made.iter().any(|(q, _)| *q == Quantity::Sum { square: squares, wide: true });
        let bits = |v: f64| [v.to_bits() as u32, (v.to_bits() >> 32) as u32];
        let whole: usize = job.radius.iter().map(|r| 2 * r + 1).product();
        // One division for all windows that are whole.
        let scaled = !self.affine.is_identity();
        let mean = self.asks(&[5]) || self.asks(&[0]) && (scaled || job.count() >= NEAREST);
        let strips = part.dst[1].div_ceil(STRIP);
        let threads = (part.dst[0] * strips * part.dst[2]) as u32;
        let codes = Codes {
            out: [part.dst[1] as u32, part.dst[2] as u32],
            centre: centre as u32,
            plane: strides[0] as u32,
            row: strides[1] as u32,
            packing: if job.voxel == 1 { 2 } else { 1 },
            flip: job.flip(),
            wide: wide(true) as u32,
            at: std::array::from_fn(|a| (job.at[a] + part.lo[a]) as u32),
            radius: job.radius.map(|r| r as u32),
            size: job.src.map(|n| n as u32),
            centred: match Width::of(job.count(), (1 << (8 * job.voxel)) - 1) {
                Width::Small | Width::Direct => 0,
                Width::Centred => 1,
                Width::Big => 2,
            },
            count: self.count as u32,
            stride: planes.stride,
            flipped: self.flipped as u32,
            scaled: scaled as u32,
            threads,
            needs: job.needs.mean as u32
                + 2 * job.needs.variance as u32
                + 4 * job.needs.extremes as u32
                + 8 * mean as u32
                + 16 * self.asks(&[3, 4, 5]) as u32,
            whole: u32::try_from(whole).unwrap_or(0),
            strips: strips as u32,
            share: bits(1.0 / whole as f64),
            slope: bits(self.affine.slope),
            intercept: bits(self.affine.intercept),
            inverse: 1.0 / whole as f32,
            spare: [0; 3],
            channels: self.codes,
        };
        let [extremes, sums, squares] = [
            of(|q| *q == Quantity::Extremes),
            of(|q| matches!(q, Quantity::Sum { square: false, .. })),
            of(|q| matches!(q, Quantity::Sum { square: true, .. })),
        ];
        to.dispatch(Shader::Codes, 0, &codes, &[source[0], source[1], extremes, sums, squares], threads);
        let exact = mean || scaled || self.asks(&[3, 4, 5]);
        let spread = [7, 8, 9].iter().any(|c| self.asks(&[*c, c + 256]));
        let power = self.asks(&[6, 262]);
        let counted = job.needs.mean || job.needs.variance;
        let other = exact || self.codes[..self.count] != [0];
        let parts = [exact, job.needs.variance, power, spread, counted, other, wide(false)];
        to.only(parts.iter().enumerate().map(|(k, part)| (*part as u32) << k).sum());
        planes
    }
}

/// A channel as the shader knows it.
fn code(channel: WindowChannel) -> Option<u32> {
    let open = |method| match method {
        Method::CdfPower => Some(6),
        Method::GaussianCdf => Some(7),
        Method::Chebyshev => Some(8),
        Method::ChebyshevLiteral => Some(9),
        _ => None,
    };
    match channel {
        WindowChannel::Mean => Some(0),
        WindowChannel::Min => Some(1),
        WindowChannel::Max => Some(2),
        WindowChannel::Variance => Some(3),
        WindowChannel::Std => Some(4),
        WindowChannel::Moment2 => Some(5),
        WindowChannel::Openness(method, ties) => Some(open(method)? + if ties == Ties::Mid { 256 } else { 0 }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaled_floats_and_channels_without_a_code_are_finished_by_the_cpu() {
        let params = WindowParams { radius: [1; 3], affine: Affine::IDENTITY, missing: None, solid_low: true };
        let open = |m| WindowChannel::Openness(m, Ties::Mid);
        let made = Channels::of(&params, &[WindowChannel::Mean, open(Method::Chebyshev)], true).unwrap();
        assert_eq!((made.count(), &made.codes[..3], made.flipped), (2, &[0, 264, 0][..], true));
        assert!(Channels::of(&params, &[open(Method::Beta)], false).is_none());
        assert!(Channels::of(&params, &[WindowChannel::Mean; MOST + 1], false).is_none());
        let scaled = WindowParams { affine: Affine { slope: 2.0, intercept: 0.0 }, ..params };
        assert!(Channels::of(&scaled, &[WindowChannel::Mean], true).is_none());
        assert!(Channels::of(&scaled, &[WindowChannel::Mean], false).is_some());
    }
}
