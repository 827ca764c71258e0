//! What the device makes of moments of f32, so that only results come back: channels as the shader knows them, and the
//! dispatch.

use super::passes::{Job, Part};
use super::record::{Buffer, Dispatch, Shader};
use crate::stage::{Method, Ties, WindowChannel, WindowParams};

/// Most channels of one dispatch.
pub const MOST: usize = 16;

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
    pub spare: u32,
    pub channels: [u32; MOST],
}

/// Channels that the device finishes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Channels {
    codes: [u32; MOST],
    count: usize,
    flipped: bool,
}

impl Channels {
    /// `None` where values are scaled (f64 does that on the CPU), or a channel has no code.
    pub fn of(params: &WindowParams, channels: &[WindowChannel]) -> Option<Channels> {
        if !params.affine.is_identity() || channels.len() > MOST {
            return None;
        }
        let mut codes = [0; MOST];
        for (to, channel) in codes.iter_mut().zip(channels) {
            *to = code(*channel)?;
        }
        Some(Channels { codes, count: channels.len(), flipped: params.flipped() })
    }

    pub fn count(&self) -> usize {
        self.count
    }

    /// Bytes of all results of a part, one channel after the other.
    pub fn bytes(&self, part: &Part) -> u64 {
        part.dst.iter().map(|&n| n as u64).product::<u64>() * 4 * self.count as u64
    }

    /// From voxels, extremes and cells of `cell` words (0: none) to results.
    pub(super) fn dispatch(&self, job: &Job, part: &Part, cell: usize) -> Dispatch {
        let pitch = job.pitch(part);
        let strides = [part.src[1] * pitch, pitch, 1];
        let centre: usize = (0..3).map(|a| (job.at[a] + part.lo[a] - part.from[a]) * strides[a]).sum();
        let threads = part.dst.iter().product::<usize>() as u32;
        let finish = Finish {
            out: part.dst.map(|n| n as u32),
            centre: centre as u32,
            plane: strides[0] as u32,
            row: strides[1] as u32,
            cell: cell as u32,
            flipped: self.flipped as u32,
            count: self.count as u32,
            threads,
            channels: self.codes,
            ..Finish::default()
        };
        let params = bytemuck::bytes_of(&finish).to_vec();
        let bind = vec![Buffer::Source, Buffer::B, Buffer::C, Buffer::A];
        Dispatch { shader: Shader::Finish, entry: 0, params, bind, threads }
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
    use crate::grid::Affine;

    #[test]
    fn scaled_values_and_channels_without_a_code_are_finished_by_the_cpu() {
        let params = WindowParams { radius: [1; 3], affine: Affine::IDENTITY, missing: None, solid_low: true };
        let open = |m| WindowChannel::Openness(m, Ties::Mid);
        let made = Channels::of(&params, &[WindowChannel::Mean, open(Method::Chebyshev)]).unwrap();
        assert_eq!((made.count(), &made.codes[..3], made.flipped), (2, &[0, 264, 0][..], true));
        assert!(Channels::of(&params, &[open(Method::Beta)]).is_none());
        assert!(Channels::of(&params, &[WindowChannel::Mean; MOST + 1]).is_none());
        let scaled = WindowParams { affine: Affine { slope: 2.0, intercept: 0.0 }, ..params };
        assert!(Channels::of(&scaled, &[WindowChannel::Mean]).is_none());
    }
}
