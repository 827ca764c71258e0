//! Errors of a run against its truth: over all judged voxels, over windows that are not constant, and over the surface band
//! (the fifth of the judged voxels where the input's gradient is largest). A background of one value says little about an
//! estimator.

use serde_json::json;

use super::super::cmd_compare::{Difference, Sums};
use super::super::moments::{Magnitudes, Moments};
use super::super::reader::{Volume, read_box};
use super::super::similarity::Ssim;
use super::sample::Judged;
use crate::Result;
use crate::grid::Shape;
use crate::run::Cancel;

/// Share of the voxels that the surface band leaves out.
const BELOW_BAND: f64 = 0.8;

/// What a run is judged by.
pub struct Judges<'a> {
    pub truth: &'a Volume,
    /// Spread of the windows; `None` for stages without windows.
    pub spread: Option<&'a Volume>,
    /// Gradient of the input and the least of the surface band.
    pub gradient: Option<(&'a Volume, f64)>,
    pub judged: &'a Judged,
}

/// Errors, bias being the run's value less the truth's; parts are `None` where the stage has no such thing.
#[derive(Debug, Clone, PartialEq)]
pub struct Errors {
    pub all: Difference,
    pub windows: Option<Difference>,
    pub surface: Option<Difference>,
}

/// Calls `then` with values of all volumes for each plane of the volume, or for each judged brick, with the block's shape.
fn blocks(
    volumes: &[(&Volume, usize)],
    judged: &Judged,
    cancel: &Cancel,
    mut then: impl FnMut(&[Vec<f64>], Shape),
) -> Result<()> {
    if let Some(cells) = &judged.cells {
        for cell in cells {
            cancel.check()?;
            let read = |(v, c): &(&Volume, usize)| read_box(v, *c, *cell);
            then(&volumes.iter().map(read).collect::<Result<Vec<_>>>()?, cell.shape());
        }
        return Ok(());
    }
    let mut planes = volumes.iter().map(|(v, c)| v.planes(*c)).collect::<Result<Vec<_>>>()?;
    let mut values: Vec<Vec<f64>> = planes.iter().map(|p| vec![0.0; p.plane_voxels()]).collect();
    let [_, ny, nx] = volumes[0].0.info().shape;
    loop {
        cancel.check()?;
        for (planes, values) in planes.iter_mut().zip(&mut values) {
            if !planes.next(values)? {
                return Ok(());
            }
        }
        then(&values, [1, ny, nx]);
    }
}

/// The least gradient of the surface band.
pub fn band_from(gradient: &Volume, judged: &Judged, cancel: &Cancel) -> Result<f64> {
    let mut magnitudes = Magnitudes::default();
    blocks(&[(gradient, 0)], judged, cancel, |values, _| {
        values[0].iter().filter(|v| v.is_finite()).for_each(|v| magnitudes.add(*v));
    })?;
    Ok(magnitudes.quantile(BELOW_BAND))
}

/// Dynamic range of the truth, for SSIM: 1 for openness and for constants.
fn range(of: &Judges, run: &Volume, components: usize, cancel: &Cancel) -> Result<f64> {
    if run.attributes.is_openness() {
        return Ok(1.0);
    }
    let mut all = Moments::default();
    for c in 0..components {
        blocks(&[(of.truth, c)], of.judged, cancel, |values, _| all = all.merge(Moments::of(&values[0])))?;
    }
    Ok(all.dynamic_range())
}

/// Errors of a run; of all components together.
pub fn errors(of: &Judges, run: &Volume, cancel: &Cancel) -> Result<Errors> {
    let components = run.info().components.max(1);
    let range = range(of, run, components, cancel)?;
    let mut sums: [Sums; 3] = Default::default();
    for c in 0..components {
        let mut volumes = vec![(run, c), (of.truth, c)];
        volumes.extend(of.spread.map(|v| (v, 0)));
        volumes.extend(of.gradient.map(|(v, _)| (v, 0)));
        let mut planes: Option<Ssim> = None;
        blocks(&volumes, of.judged, cancel, |values, shape| {
            let (run, truth) = (&values[0], &values[1]);
            sums[0].add(run, truth);
            if of.spread.is_some() {
                sums[1].add(&where_above(run, &values[2], 0.0), truth);
            }
            if let Some((_, least)) = of.gradient {
                sums[2].add(&where_above(run, &values[volumes.len() - 1], least), truth);
            }
            match &of.judged.cells {
                None => planes.get_or_insert_with(|| Ssim::new([shape[1], shape[2]], range)).push_plane(run, truth),
                Some(_) => sums[0].similar(brick(run, truth, shape, range)),
            }
        })?;
        if let Some(ssim) = planes {
            sums[0].similar(ssim.finish());
        }
    }
    let [all, windows, surface] = sums.map(Sums::finish);
    Ok(Errors { all, windows: of.spread.map(|_| windows), surface: of.gradient.map(|_| surface) })
}

/// Similarity over the whole windows of one brick.
fn brick(a: &[f64], b: &[f64], [_, ny, nx]: Shape, range: f64) -> (f64, u64) {
    let mut ssim = Ssim::new([ny, nx], range);
    a.chunks_exact(ny * nx).zip(b.chunks_exact(ny * nx)).for_each(|(a, b)| ssim.push_plane(a, b));
    ssim.finish()
}

/// Values where `mask` is above `bound`, NaN, which does not count, elsewhere.
fn where_above(values: &[f64], mask: &[f64], bound: f64) -> Vec<f64> {
    values.iter().zip(mask).map(|(v, m)| if *m > bound { *v } else { f64::NAN }).collect()
}

/// Errors over a part of the voxels as JSON; whole windows, and so SSIM, are of the volume only.
pub fn part_json(part: &Difference) -> serde_json::Value {
    json!({
        "rmse": part.rmse, "mae": part.mae, "bias": part.bias, "max_abs": part.max_abs, "p99": part.p99, "n": part.n,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_voxels_above_the_bound_count() {
        let mut sums = Sums::default();
        let run = where_above(&[3.0, 9.0, 0.0, 1.0, 4.0], &[2.0, 1.0, 2.0, 2.0, f64::NAN], 1.0);
        sums.add(&run, &[0.0, 0.0, 1.0, f64::NAN, 0.0]);
        let part = sums.finish();
        assert_eq!((part.n, part.bias, part.max_abs), (2, 1.0, 3.0));
        assert!((part.rmse - 5f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn a_brick_is_as_similar_as_the_volume_that_is_it() {
        let shape = [13, 12, 14];
        let a: Vec<f64> = (0..shape.iter().product()).map(|i| f64::from((i * 37 % 101) as u8) / 100.0).collect();
        let b: Vec<f64> = a.iter().map(|v| v * 0.9).collect();
        let (mean, windows) = brick(&a, &b, shape, 1.0);
        assert_eq!(windows, 3 * 2 * 4);
        assert!(mean > 0.5 && mean < 1.0 && brick(&a, &a, shape, 1.0).0 > 1.0 - 1e-9, "{mean}");
        assert_eq!(brick(&a[..140], &b[..140], [1, 10, 14], 1.0).1, 0, "no whole window");
    }
}
