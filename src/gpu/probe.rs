//! Holds a device to the f32 arithmetic that the shaders ask for, before anything is placed on it that needs it.

use super::engine::{Gpu, GpuError, Times, run_part};
use super::facts::tolerance;
use super::pairs::{self, Arithmetic, Cell};
use super::passes::{self, Quantity, result_bytes};
use super::slopes::Fit;
use super::windows::{cast, pack};
use crate::brick::{Scratch, Voxels};
use crate::grid::{Affine, AnyView, DType, Shape, View};
use crate::kernel::gradient::{self, GradientOut};
use crate::kernel::simd::Level;
use crate::kernel::window::{self, Place, WindowOut};
use crate::kernel::{Context, gaussian};
use crate::stage::{GradientWeight, Method, Ties, WindowChannel, WindowParams};

impl Gpu {
    /// Whether f32 operations that shaders keep apart are rounded one by one, in their order: a Gaussian and moments of
    /// windows, on voxels on which a fused or reordered sum shows, against the same operations here.
    pub(super) fn probe(&self) -> Result<bool, GpuError> {
        Ok(self.probe_gaussian()? && self.probe_moments()?)
    }

    /// Whether floats that need not be the CPU's to the bit lie within their tolerances: openness of integers (and of f32, where
    /// windows of f32 run here) and gradients. Divisions, roots and what a compiler makes of polynomials are the driver's;
    /// Vulkan bounds their errors ([`super::backend::BOUNDS_ERRORS`]), so that there only tests ask.
    #[doc(hidden)]
    pub fn probe_close(&self) -> Result<bool, GpuError> {
        let integers = volume();
        let mut close = self.probe_openness(&integers)? && self.probe_gradient(&integers)?;
        if self.facts().exact_floats {
            let floats = Voxels::F32((0..integers.len()).map(|i| integers.at(i) as f32 / 7.0).collect());
            close = close && self.probe_openness(&floats)?;
        }
        Ok(close)
    }

    fn probe_openness(&self, volume: &Voxels) -> Result<bool, GpuError> {
        let methods = [Method::CdfPower, Method::GaussianCdf, Method::Chebyshev, Method::ChebyshevLiteral];
        let params = WindowParams { radius: [1, 2, 4], affine: Affine::IDENTITY, missing: None, solid_low: false };
        let mut scratch = Scratch::new();
        let mut made = [0, 1].map(|_| methods.map(|_| Voxels::zeroed(DType::F32, volume.len())));
        for (k, made) in made.iter_mut().enumerate() {
            let outs = made.iter_mut().zip(methods);
            let mut outs: Vec<WindowOut> = outs
                .map(|(v, m)| WindowOut { channel: WindowChannel::Openness(m, Ties::Le), dst: v.view_mut(EXTENT) })
                .collect();
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            match k {
                0 => window::window(volume.view(EXTENT), &params, Place::whole([0; 3]), &mut outs, &mut cx),
                _ => self.window(volume.view(EXTENT), &params, [0; 3], [0; 3], &mut outs, &mut cx).map(|_| ())?,
            }
        }
        let [cpu, gpu] = made;
        Ok(cpu.iter().zip(&gpu).all(|(a, b)| within(a, b, tolerance::OPENNESS)))
    }

    fn probe_gradient(&self, volume: &Voxels) -> Result<bool, GpuError> {
        let fit = Fit { size: 5, weight: GradientWeight::Distance, spacing: [1.0; 3], missing: None };
        let dst: Shape = EXTENT.map(|n| n - 4);
        let mut scratch = Scratch::new();
        let mut made = [0, 1].map(|_| [0; 4].map(|_| Voxels::zeroed(DType::F32, dst.iter().product())));
        for (k, [m, z, y, x]) in made.iter_mut().enumerate() {
            let out =
                GradientOut { magnitude: Some(m.view_mut(dst)), vector: Some([z, y, x].map(|v| v.view_mut(dst))) };
            let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
            let (src, at) = (volume.view(EXTENT), [2; 3]);
            match k {
                0 => {
                    gradient::gradient(src, fit.size, fit.weight, fit.spacing, Affine::IDENTITY, None, at, out, &mut cx)
                }
                _ => self.gradient(src, &fit, Affine::IDENTITY, at, out, &mut cx).map(|_| ())?,
            }
        }
        let [cpu, gpu] = made;
        Ok(cpu.iter().zip(&gpu).all(|(a, b)| within(a, b, tolerance::GRADIENT * 65536.0)))
    }

    fn probe_gaussian(&self) -> Result<bool, GpuError> {
        let volume = volume();
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let (src, at) = (volume.view(EXTENT), [0; 3]);
        let [mut cpu, mut gpu] = [0, 1].map(|_| Voxels::zeroed(DType::F32, volume.len()));
        let mean = Some(cpu.view_mut(EXTENT));
        gaussian::gaussian(src, SIGMA, Affine::IDENTITY, None, at, mean, None, &mut cx);
        self.gaussian(src, SIGMA, Affine::IDENTITY, at, Some(gpu.view_mut(EXTENT)), None, &mut cx)?;
        Ok(cpu.as_bytes() == gpu.as_bytes())
    }

    fn probe_moments(&self) -> Result<bool, GpuError> {
        let (job, part) = pairs::probe_job();
        let voxels = pairs::probe_voxels();
        let src = AnyView::F32(View::dense(&voxels, pairs::PROBE));
        let expect = Arithmetic::Apart.moments(&job, &part, &voxels, true);
        let start = result_bytes(&part, Quantity::Order).next_multiple_of(256) as usize;
        let len = result_bytes(&part, Quantity::Moments { square: true }) as usize;
        let mut same = false;
        self.attempt(|device| {
            let mut fill = |out: &mut wgpu::WriteOnly<[u8]>| pack(src, &part, 4 * job.pitch(&part), out);
            let mut done = |bytes: Option<&[u8]>| {
                let words: &[u32] = cast(&bytes.unwrap_or_default()[start..start + len])?;
                let cells = words.chunks_exact(passes::cell(true)).map(Cell::from_words);
                same = cells.eq(expect.iter().copied());
                Ok(())
            };
            run_part(device, &job.record(&part), &mut fill, &mut done, &mut Times::default())
        })?;
        Ok(same)
    }
}

/// Whether no voxel is further from its twin; NaN is far from everything.
fn within(a: &Voxels, b: &Voxels, bound: f64) -> bool {
    a.len() == b.len() && (0..a.len()).all(|i| (a.at(i) - b.at(i)).abs() <= bound)
}

/// Extent and sigma of the Gaussian.
const EXTENT: Shape = [5, 8, 64];
const SIGMA: [f64; 3] = [0.8, 1.3, 2.4];

fn volume() -> Voxels {
    let mut volume = Voxels::zeroed(DType::I16, EXTENT.iter().product());
    let mut state = 1u64;
    for byte in volume.as_bytes_mut() {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        *byte = (state >> 56) as u8;
    }
    volume
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{AnyViewMut, ViewMut};

    /// One row by the shader's formula, its products fused into the sums or not.
    fn row(values: &[f32], fused: bool) -> Vec<f32> {
        let (n, radius) = (values.len(), gaussian::shared::radius(SIGMA, EXTENT)[2]);
        let tap = |p: usize, k: isize| values.get(p.wrapping_add_signed(k)).copied().unwrap_or(values[p]);
        let one = |p: usize| {
            let c = values[p];
            let taps = gaussian::shared::weights(SIGMA[2], radius, p, n).zip(1..);
            taps.fold(c, |sum, (w, k)| {
                let d = (tap(p, -k) + tap(p, k)) - (c + c);
                if fused { w.mul_add(d, sum) } else { sum + w * d }
            })
        };
        (0..n).map(one).collect()
    }

    #[test]
    fn the_bound_is_one_and_nan_is_not_close() {
        let of = |v: f32| Voxels::F32(vec![0.5, v]);
        assert!(within(&of(0.25), &of(0.25), 0.0) && within(&of(0.25), &of(0.375), 0.125));
        assert!(!within(&of(0.25), &of(0.376), 0.125) && !within(&of(0.25), &of(f32::NAN), 0.125));
        assert!(!within(&of(0.25), &Voxels::F32(vec![0.5]), 0.125));
    }

    #[test]
    fn the_probe_would_notice_a_compiler_that_fuses() {
        let volume = volume();
        let values: Vec<f32> = (0..EXTENT[2]).map(|i| volume.at(i) as f32).collect();
        let mut plain = vec![0.0f32; EXTENT[2]];
        let mut scratch = Scratch::new();
        let mut cx = Context { level: Level::detect(), scratch: &mut scratch };
        let shape = [1, 1, EXTENT[2]];
        let mean = AnyViewMut::F32(ViewMut::dense(&mut plain, shape));
        let src = volume.view(EXTENT);
        let AnyView::I16(src) = src else { unreachable!() };
        let src = AnyView::I16(src.part([0; 3], shape));
        gaussian::gaussian(src, SIGMA, Affine::IDENTITY, None, [0; 3], Some(mean), None, &mut cx);
        assert_eq!(plain, row(&values, false), "the formula is the kernel's");
        assert_ne!(plain, row(&values, true), "fused sums must show");
    }
}
