//! Where `occlude pareto` judges besides everywhere: windows that are not constant, and the surface band (the fifth of the
//! voxels where the input's gradient is largest). A background of one value says little about an estimator.

use std::path::Path;

use serde_json::json;

use super::moments::Magnitudes;
use super::reader::Volume;
use crate::Result;
use crate::config::{Config, Op, OutputDType, Ref, StageNode};
use crate::grid::Border;
use crate::run::Cancel;
use crate::stage::GradientWeight;

/// Share of the voxels that the surface band leaves out.
const BELOW_BAND: f64 = 0.8;
/// Name of the stage that a helper run adds; a config's names cannot hold the character.
const HELPER: &str = "pareto:helper";

/// Errors over a part of the voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    pub rmse: f64,
    pub bias: f64,
    pub n: u64,
}

impl Part {
    pub fn json(&self) -> serde_json::Value {
        json!({"rmse": self.rmse, "bias": self.bias, "n": self.n})
    }
}

/// Both parts; `None` where the stage has no such thing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Parts {
    pub windows: Option<Part>,
    pub surface: Option<Part>,
}

/// A run of `variant` (whose one output is measured) that writes the gradient's magnitude of the stage's input instead.
pub fn gradient_of(variant: &Config, stage: &str, path: &Path) -> Option<Config> {
    let node = variant.stages.iter().find(|s| s.name == stage)?;
    let input = node.op.reads().first()?.1.clone();
    let op = Op::Gradient { input, size: 3, weight: GradientWeight::Inverse };
    Some(helper(variant, node, op, "magnitude", Border::Nearest, path))
}

/// The same for the windows' standard deviation; `None` for stages without box windows.
pub fn spread_of(variant: &Config, stage: &str, path: &Path) -> Option<Config> {
    let node = variant.stages.iter().find(|s| s.name == stage)?;
    let Op::AmbientOcclusion { input, radius, .. } = &node.op else { return None };
    let op = Op::Box { input: input.clone(), radius: radius.clone() };
    Some(helper(variant, node, op, "std", node.border, path))
}

fn helper(variant: &Config, node: &StageNode, op: Op, channel: &str, border: Border, path: &Path) -> Config {
    let mut config = variant.clone();
    let stage = StageNode { name: HELPER.into(), op, border, where_: None, fill: None, place: node.place.clone() };
    config.stages.push(stage);
    for output in &mut config.outputs {
        output.from = vec![Ref { name: HELPER.into(), channel: Some(channel.into()) }];
        output.path = path.to_path_buf();
        output.dtype = Some(OutputDType::Native);
    }
    config
}

/// The least gradient of the surface band.
pub fn band_from(gradient: &Volume, cancel: &Cancel) -> Result<f64> {
    let mut magnitudes = Magnitudes::default();
    let mut planes = gradient.planes(0)?;
    let mut plane = vec![0.0; planes.plane_voxels()];
    while planes.next(&mut plane)? {
        cancel.check()?;
        plane.iter().filter(|v| v.is_finite()).for_each(|v| magnitudes.add(*v));
    }
    Ok(magnitudes.quantile(BELOW_BAND))
}

/// Errors of `b` against `a` where `mask` is above `bound`; of all components together.
pub fn errors(a: &Volume, b: &Volume, mask: &Volume, bound: f64, cancel: &Cancel) -> Result<Part> {
    let mut sums = Sums::default();
    for component in 0..a.info().components.max(1) {
        let mut planes = [a.planes(component)?, b.planes(component)?, mask.planes(0)?];
        let mut values = [0; 3].map(|_| vec![0.0; planes[0].plane_voxels()]);
        'planes: loop {
            cancel.check()?;
            for (planes, values) in planes.iter_mut().zip(&mut values) {
                if !planes.next(values)? {
                    break 'planes;
                }
            }
            sums.add(&values[0], &values[1], &values[2], bound);
        }
    }
    Ok(sums.part())
}

#[derive(Default)]
struct Sums {
    n: u64,
    signed: f64,
    squares: f64,
}

impl Sums {
    fn add(&mut self, a: &[f64], b: &[f64], mask: &[f64], bound: f64) {
        let (mut signed, mut squares) = (0.0, 0.0);
        for ((a, b), m) in a.iter().zip(b).zip(mask) {
            let d = b - a;
            if *m > bound && !d.is_nan() {
                (signed, squares, self.n) = (signed + d, squares + d * d, self.n + 1);
            }
        }
        // Sums per plane, so that long volumes lose no digits.
        (self.signed, self.squares) = (self.signed + signed, self.squares + squares);
    }

    fn part(&self) -> Part {
        let n = self.n as f64;
        Part { rmse: (self.squares / n).sqrt(), bias: self.signed / n, n: self.n }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_voxels_above_the_bound_count() {
        let mut sums = Sums::default();
        sums.add(&[0.0, 0.0, 1.0, f64::NAN], &[3.0, 9.0, 0.0, 1.0], &[2.0, 1.0, 2.0, 2.0], 1.0);
        let part = sums.part();
        assert_eq!((part.n, part.bias, part.rmse), (2, 1.0, 5f64.sqrt()));
        assert!(Sums::default().part().rmse.is_nan());
    }
}
