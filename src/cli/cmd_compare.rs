//! `occlude compare`.

use std::process::ExitCode;

use rayon::prelude::*;
use serde_json::json;

use super::args::CompareArgs;
use super::moments::{Magnitudes, Moments};
use super::progress::{Count, Shown};
use super::reader::{Planes, Volume};
use super::similarity::Ssim;
use super::{human, messages, usage};
use crate::Result;
use crate::run::{Cancel, Progress};

/// How two volumes differ, over the voxels that both have.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// Root of the mean squared difference.
    pub rmse: f64,
    /// Mean absolute difference.
    pub mae: f64,
    /// Mean of A - B.
    pub bias: f64,
    pub max_abs: f64,
    /// 99th percentile of the absolute difference (nearest rank).
    pub p99: f64,
    /// Mean structural similarity over whole windows; `None` where no window fits.
    pub ssim: Option<f64>,
    /// Pairs that count: neither value is missing.
    pub n: u64,
    /// Voxels that only the other volume has, of A and of B.
    pub missing: [u64; 2],
}

/// Compares, prints, and fails beyond the bound.
pub fn run(args: &CompareArgs, quiet: bool) -> Result<ExitCode> {
    let cancel = messages::interrupts();
    let a = Volume::open(&args.a, 0, &args.raw, &cancel)?;
    let b = Volume::open(&args.b, 0, &args.raw, &cancel)?;
    let shown = Shown::patient(quiet);
    let d = compare(&a, &b, &cancel, &shown);
    shown.finish();
    let d = d?;
    if args.json {
        messages::result_json(&d.json())?;
    } else {
        messages::result(&d.text())?;
    }
    if let Some(note) = d.unpaired() {
        messages::note(&note);
    }
    match args.max_rmse {
        // Not a number is beyond every bound.
        Some(bound) if d.rmse.is_nan() || d.rmse > bound => {
            messages::note(&format!("rmse {} is beyond the bound {}", human::number(d.rmse), human::number(bound)));
            Ok(ExitCode::from(1))
        }
        _ => Ok(ExitCode::SUCCESS),
    }
}

/// Streams both volumes, plane by plane and component by component.
pub fn compare(a: &Volume, b: &Volume, cancel: &Cancel, progress: &dyn Progress) -> Result<Difference> {
    let (ia, ib) = (a.info(), b.info());
    if ia.shape != ib.shape {
        let message = format!(
            "{} has {} voxels, {} has {}; expected equal shapes",
            a.path.display(),
            human::extent(ia.shape),
            b.path.display(),
            human::extent(ib.shape)
        );
        return Err(usage("B", message));
    }
    if ia.components != ib.components {
        let message = format!("A has {} channels, B has {}; expected as many", ia.components, ib.components);
        return Err(usage("B", message));
    }
    let components = ia.components.max(1);
    let range = match a.attributes.is_openness() {
        true => 1.0,
        false => value_range(a, components, cancel, progress)?,
    };
    let mut count = Count::new(progress, "compare", components * ia.voxels());
    let mut sums = Sums::default();
    let pair = || [0, 1].map(|_| vec![0.0; ia.shape[1] * ia.shape[2]]);
    let (mut here, mut ahead) = (pair(), pair());
    for component in 0..components {
        let mut planes = [a.planes(component)?, b.planes(component)?];
        let mut similarity = Ssim::new([ia.shape[1], ia.shape[2]], range);
        let mut more = next_pair(&mut planes, &mut here)?;
        while more {
            cancel.check()?;
            let [va, vb] = &here;
            let read = || next_pair(&mut planes, &mut ahead);
            let take = || rayon::join(|| sums.add(va, vb), || similarity.push_plane(va, vb));
            let (read, _) = rayon::join(read, take);
            more = read?;
            count.add(va.len());
            std::mem::swap(&mut here, &mut ahead);
        }
        sums.similar(similarity.finish());
    }
    Ok(sums.finish())
}

/// The next plane of both volumes; false after the last.
fn next_pair(planes: &mut [Planes; 2], into: &mut [Vec<f64>; 2]) -> Result<bool> {
    let ([pa, pb], [va, vb]) = (planes, into);
    Ok(pa.next(va)? && pb.next(vb)?)
}

/// Largest minus least finite value of all components; 1 of a constant, so that equal constants are alike.
fn value_range(volume: &Volume, components: usize, cancel: &Cancel, progress: &dyn Progress) -> Result<f64> {
    let mut all = Moments::default();
    let mut count = Count::new(progress, "range of A", components * volume.info().voxels());
    for component in 0..components {
        volume.each_plane(component, cancel, &mut count, &mut |plane| all = all.merge(Moments::of(plane)))?;
    }
    Ok(all.dynamic_range())
}

/// Pairs that are summed at a time.
const BLOCK: usize = 1 << 14;

/// Sums over the pairs of a block.
struct Block {
    /// Of A - B.
    signed: Moments,
    absolute: f64,
    squares: f64,
    max_abs: f64,
    missing: [u64; 2],
}

/// A - B; 0 of equal infinities.
fn difference(a: f64, b: f64) -> f64 {
    if a == b { 0.0 } else { a - b }
}

impl Block {
    fn of(a: &[f64], b: &[f64]) -> Block {
        let all: Vec<f64> = a.iter().zip(b).map(|(a, b)| difference(*a, *b)).collect();
        let mut block = Block { signed: Moments::of(&all), absolute: 0.0, squares: 0.0, max_abs: 0.0, missing: [0; 2] };
        for d in all.iter().filter(|d| !d.is_nan()) {
            block.absolute += d.abs();
            block.squares += d * d;
            block.max_abs = block.max_abs.max(d.abs());
        }
        for (a, b) in a.iter().zip(b) {
            block.missing[0] += u64::from(a.is_nan() && !b.is_nan());
            block.missing[1] += u64::from(b.is_nan() && !a.is_nan());
        }
        block
    }
}

/// Running sums over pairs.
#[derive(Default)]
pub struct Sums {
    /// Of A - B; its mean is the bias.
    signed: Moments,
    absolute: f64,
    squares: f64,
    max_abs: f64,
    magnitudes: Magnitudes,
    /// Sum of window values and how many there are.
    similarity: (f64, u64),
    missing: [u64; 2],
}

impl Sums {
    /// Takes in pairs; those with a NaN do not count. Blocks are summed side by side and taken in in order, so that nothing
    /// depends on the threads and long volumes lose no digits.
    pub fn add(&mut self, a: &[f64], b: &[f64]) {
        let magnitudes = &mut self.magnitudes;
        let count = || {
            let all = a.iter().zip(b).map(|(a, b)| difference(*a, *b).abs());
            all.filter(|d| !d.is_nan()).for_each(|d| magnitudes.add(d));
        };
        let sum = || a.par_chunks(BLOCK).zip(b.par_chunks(BLOCK)).map(|(a, b)| Block::of(a, b)).collect();
        let (_, blocks): ((), Vec<Block>) = rayon::join(count, sum);
        for block in blocks {
            self.absolute += block.absolute;
            self.squares += block.squares;
            self.max_abs = self.max_abs.max(block.max_abs);
            self.signed = self.signed.merge(block.signed);
            (0..2).for_each(|k| self.missing[k] += block.missing[k]);
        }
    }

    /// Takes in a mean similarity and its number of windows.
    pub fn similar(&mut self, (mean, windows): (f64, u64)) {
        if windows > 0 {
            self.similarity.0 += mean * windows as f64;
            self.similarity.1 += windows;
        }
    }

    pub fn finish(self) -> Difference {
        let n = self.signed.n + self.signed.infinite;
        let mean = |sum: f64| if n == 0 { f64::NAN } else { sum / n as f64 };
        Difference {
            rmse: mean(self.squares).sqrt(),
            mae: mean(self.absolute),
            bias: if self.signed.infinite > 0 || n == 0 { f64::NAN } else { self.signed.mean },
            max_abs: if n == 0 { f64::NAN } else { self.max_abs },
            // Magnitudes are kept as f32, which rounds.
            p99: self.magnitudes.quantile(0.99).min(self.max_abs),
            ssim: (self.similarity.1 > 0).then(|| self.similarity.0 / self.similarity.1 as f64),
            n,
            missing: self.missing,
        }
    }
}

impl Difference {
    /// What no number above tells, where a volume lacks voxels that the other one has.
    fn unpaired(&self) -> Option<String> {
        let [a, b] = self.missing;
        (a + b > 0).then(|| format!("{a} voxels are missing in A alone and {b} in B alone; no number counts them"))
    }

    /// Numbers by name; what is not finite becomes null.
    pub fn json(&self) -> serde_json::Value {
        json!({
            "rmse": self.rmse, "mae": self.mae, "bias": self.bias, "max_abs": self.max_abs, "p99": self.p99,
            "ssim": self.ssim, "n": self.n, "missing_a": self.missing[0], "missing_b": self.missing[1],
        })
    }

    /// A line per number.
    pub fn text(&self) -> String {
        let ssim = self.ssim.map_or("none (no whole window)".to_string(), |s| format!("{s:.6}"));
        let [rmse, mae, bias, max_abs, p99] =
            [self.rmse, self.mae, self.bias, self.max_abs, self.p99].map(human::number);
        format!(
            "rmse    {rmse}\nmae     {mae}\nbias    {bias}\nmax_abs {max_abs}\np99     {p99}\nssim    {ssim}\nn       {}",
            self.n
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_skip_missing_voxels_and_count_the_rest() {
        let mut s = Sums::default();
        s.add(&[1.0, 2.0, f64::NAN, 4.0], &[1.0, 1.0, 5.0, 7.0]);
        s.add(&[0.0, f64::NAN], &[f64::NAN, 0.0]);
        s.similar((0.5, 2));
        s.similar((1.0, 2));
        s.similar((f64::NAN, 0));
        let d = s.finish();
        assert_eq!(d.n, 3);
        assert!((d.rmse - (10.0f64 / 3.0).sqrt()).abs() < 1e-15);
        assert!((d.mae - 4.0 / 3.0).abs() < 1e-15);
        assert!((d.bias + 2.0 / 3.0).abs() < 1e-15);
        assert_eq!((d.max_abs, d.p99, d.ssim), (3.0, 3.0, Some(0.75)));
        assert_eq!(d.missing, [2, 1]);
        assert_eq!((d.json()["missing_a"].as_u64(), d.json()["missing_b"].as_u64()), (Some(2), Some(1)));
        assert!(d.unpaired().unwrap().starts_with("2 voxels are missing in A alone and 1 in B"));
        let nothing = Sums::default().finish();
        assert!(nothing.rmse.is_nan() && nothing.ssim.is_none() && nothing.n == 0 && nothing.unpaired().is_none());
    }

    #[test]
    fn equal_infinities_are_equal() {
        let mut s = Sums::default();
        s.add(&[f64::INFINITY, 1.0], &[f64::INFINITY, 1.0]);
        let d = s.finish();
        assert_eq!((d.n, d.rmse, d.bias), (2, 0.0, 0.0));
        let mut s = Sums::default();
        s.add(&[f64::INFINITY], &[1.0]);
        assert_eq!(s.finish().rmse, f64::INFINITY);
    }
}
