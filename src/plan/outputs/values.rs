//! What voxels of an output hold: element type, reduction of levels, range of codes, and what stands for missing ones.

use super::OutputPlan;
use crate::config::{Config, Output, OutputDType, OutputRange};
use crate::grid::DType;
use crate::kernel::convert::Mapping;
use crate::plan::graph::{Producer, Wire};
use crate::stage::Reduce;
use crate::{Error, Result};

/// Element type of a wire's scaled values: its own, unless scaling applies.
pub(super) fn value_dtype(wire: &Wire) -> DType {
    if wire.affine.is_identity() { wire.dtype } else { wire.dtype.result() }
}

/// Element type of an output whose channels have the type `native`, and `default` where the config asks for none.
pub(super) fn choose_dtype(output: &Output, native: DType, default: DType) -> DType {
    match output.dtype {
        None => default,
        Some(OutputDType::Native) => native,
        Some(OutputDType::U8) => DType::U8,
        Some(OutputDType::U16) => DType::U16,
        Some(OutputDType::F32) => DType::F32,
    }
}

/// How cells of levels are made; refuses what the channels do not have.
pub(super) fn choose_reduce(output: &Output, used: &[&Wire], key: &str) -> Result<Reduce> {
    let all = |names: &[&str]| used.iter().all(|w| names.contains(&w.channel.as_str()));
    let refuse = |what: &str| Err(Error::config(key, format!("{what}; accepted here: \"mean\" or \"stride\"")));
    match output.reduce {
        None => Ok(Reduce::Mean),
        Some(Reduce::Min) if !all(&["min"]) => refuse("\"min\" is for channels named min"),
        Some(Reduce::Max) if !all(&["max"]) => refuse("\"max\" is for channels named max"),
        Some(Reduce::Moments) if all(&["variance", "std"]) && !all(&["variance"]) && !all(&["std"]) => {
            refuse("\"moments\" is for variances or for standard deviations, not for both in one array")
        }
        Some(Reduce::Moments) if !all(&["variance"]) && !all(&["std"]) => {
            refuse("\"moments\" is for the channels variance and std")
        }
        Some(reduce) => Ok(reduce),
    }
}

pub(super) fn reduce_name(reduce: Reduce) -> &'static str {
    match reduce {
        Reduce::Mean => "mean",
        Reduce::Min => "min",
        Reduce::Max => "max",
        Reduce::Stride => "stride",
        Reduce::Moments => "moments",
    }
}

/// The values that map to 0 and an integer type's maximum, and whether a pre-pass must find them.
pub(super) fn choose_range(
    output: &Output,
    dtype: DType,
    native: DType,
    openness: bool,
    key: &str,
) -> Result<(Option<[f64; 2]>, bool)> {
    let asked = matches!(output.dtype, Some(OutputDType::U8 | OutputDType::U16));
    if dtype.is_float() || (dtype == native && !asked && output.range == OutputRange::Unset) {
        if output.range != OutputRange::Unset {
            return Err(Error::config(key, format!("a range is for dtype u8 or u16; this output is {dtype}")));
        }
        return Ok((None, false));
    }
    match output.range {
        OutputRange::Fixed(range) => Ok((Some(range), false)),
        OutputRange::Auto => Ok((None, true)),
        OutputRange::Unset if openness => Ok((Some([0.0, 1.0]), false)),
        OutputRange::Unset if dtype == native => Ok((None, false)),
        OutputRange::Unset => Err(Error::config(
            key,
            format!("an output of dtype {dtype} from {native} values needs `range = [lo, hi]` (or \"auto\")"),
        )),
    }
}

/// What skipped bricks hold, in the output's type.
pub(super) fn fill_value(
    config: &Config,
    output: &Output,
    dtype: DType,
    native: DType,
    range: Option<[f64; 2]>,
    wire: &Wire,
) -> f64 {
    let stage = config.stages.iter().find(|s| s.name == output.from[0].name);
    let masked = stage.is_some_and(|s| s.where_.is_some() || s.fill.is_some());
    if dtype.is_float() {
        return if masked { wire.fill } else { f64::NAN };
    }
    match range {
        None if dtype != native => 0.0, // found by a pre-pass: `OutputPlan::missing`
        _ => code(dtype, fill_of(wire, range.is_some()), range),
    }
}

/// What stands for missing voxels of a channel in integer outputs. Copies of an input keep its nodata value; where a range
/// turns values into codes, that value means nothing any more.
pub(super) fn fill_of(wire: &Wire, coded: bool) -> f64 {
    if coded && matches!(wire.producer, Producer::Input(_)) { 0.0 } else { wire.fill }
}

/// A value as an integer type stores it.
fn code(dtype: DType, value: f64, range: Option<[f64; 2]>) -> f64 {
    let (least, most) = dtype.range();
    match range {
        Some([lo, hi]) => ((value - lo) / (hi - lo) * most).round_ties_even().clamp(0.0, most),
        None => value.round_ties_even().clamp(least, most),
    }
}

impl OutputPlan {
    /// How values of a component become the output's type, once the range is known.
    pub fn mapping(&self, component: usize, range: Option<[f64; 2]>) -> Mapping {
        Mapping { range, fill: self.missing(component, range) }
    }

    /// What missing voxels of a component hold, once the range is known.
    pub fn missing(&self, component: usize, range: Option<[f64; 2]>) -> f64 {
        match self.fills.get(component) {
            Some(fill) if !self.spec.dtype.is_float() => code(self.spec.dtype, *fill, range),
            _ => self.spec.fill,
        }
    }
}
