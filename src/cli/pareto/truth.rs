//! What runs are judged by: the truth that fits each, where its windows vary, and the gradient of the input.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rayon::prelude::*;
use serde_json::json;
use toml::{Table, Value};

use super::super::args::{ParetoArgs, RawArgs};
use super::super::reader::{Volume, read_box};
use super::cost::{self, once};
use super::sample::{EDGE, Judged};
use super::settings::{self, DEVICE, agreeing, variant};
use super::two_pass::{Moment, Windows};
use crate::config::{AoRegion, Config, Device, Op, OutputDType, Pareto, Ref, StageNode};
use crate::grid::{Border, Region, Shape};
use crate::plan::Plan;
use crate::plan::graph::Lattice;
use crate::plan::lengths;
use crate::run::Cancel;
use crate::stage::{DirectionSet, DirectionWeights, GradientWeight, Method};
use crate::store::open_inputs;
use crate::store::os::FileExt;
use crate::{Error, Result};

/// Directions of the truth of a sweep.
const DIRECTIONS: usize = 6000;
/// Name of the stage that a helper run adds; a config's names cannot hold the character.
const HELPER: &str = "pareto/helper";

/// A truth: what combinations are compared with, and where their windows vary.
pub struct Truth {
    pub settings: Table,
    pub path: PathBuf,
    pub spread: Option<PathBuf>,
    pub judged: Judged,
    /// What found it.
    by: &'static str,
    /// Time that it took, of what is judged.
    pub seconds: f64,
}

/// How a truth is found.
enum Means {
    /// By the pipeline.
    Run(Box<Config>),
    /// By two passes over every window of the input.
    TwoPass { windows: Windows, moment: Moment },
}

/// What all truths of a command share.
pub struct Ground<'a> {
    pub args: &'a ParetoArgs,
    pub job: &'a Pareto,
    pub cancel: &'a Cancel,
}

impl Ground<'_> {
    /// The settings of a combination's truth: the combination with the keys that `reference` gives, or what fits the stage.
    /// Truths of the same settings are the same.
    pub fn settings(&self, run: &Config, given: &Table) -> Table {
        let mut all = given.clone();
        all.remove(DEVICE);
        if let Some(reference) = &self.job.reference {
            all.extend(reference.clone());
            return agreeing(all);
        }
        let fitting: &[(&str, Value)] = match settings::node(run, self.job).map(|n| &n.op) {
            Some(Op::AmbientOcclusion { region: AoRegion::Box, .. }) => &[("method", Value::from("exact"))],
            // The box of about the ball's volume stands for the ball.
            Some(Op::AmbientOcclusion { .. }) => &[("method", "exact".into()), ("region", "ball".into())],
            Some(Op::Obscurance(_)) => {
                ["directions", "set", "weights"].iter().for_each(|k| drop(all.remove(*k)));
                &[("directions", Value::Integer(DIRECTIONS as i64)), ("set", "fibonacci".into())]
            }
            _ => &[],
        };
        all.extend(fitting.iter().cloned().map(|(k, v)| (k.to_string(), v)));
        agreeing(all)
    }

    /// The config of the truth of a run; for windows of moments none is needed.
    fn means(&self, run: &Config, settings: &Table, judged_shape: Shape, path: &Path) -> Result<Means> {
        if self.job.reference.as_ref().is_some_and(|r| !only_counts(r)) {
            let mut config = variant(self.args, self.job, settings, path)?;
            config.run.device = Device::Cpu;
            return Ok(Means::Run(Box::new(config)));
        }
        let fitting = self.job.reference.is_none();
        if fitting && let Some((windows, moment)) = self.windows(run, judged_shape)? {
            return Ok(Means::TwoPass { windows, moment });
        }
        let mut config = run.clone();
        config.run.device = Device::Cpu;
        config.outputs.iter_mut().for_each(|o| o.path = path.to_path_buf());
        let node = config.stages.iter_mut().find(|s| s.name == self.job.stage.name);
        match node.map(|n| &mut n.op) {
            Some(Op::AmbientOcclusion { method, region, .. }) => {
                *method = Method::Exact;
                *region = if fitting && *region != AoRegion::Box { AoRegion::Ball } else { *region };
            }
            Some(Op::Obscurance(op)) if fitting => {
                (op.directions, op.set, op.weights) = (DIRECTIONS, DirectionSet::Fibonacci, DirectionWeights::Uniform);
            }
            _ => {}
        }
        Ok(Means::Run(Box::new(config)))
    }

    /// Windows whose moments a stage takes, where two passes over the input's own voxels can find them.
    fn windows(&self, run: &Config, judged_shape: Shape) -> Result<Option<(Windows, Moment)>> {
        let Some(node) = settings::node(run, self.job) else { return Ok(None) };
        let moment = match self.job.stage.channel.as_deref() {
            None | Some("mean") => Moment::Mean,
            Some("variance") => Moment::Variance,
            Some("std") => Moment::Std,
            Some("moment2") => Moment::Second,
            // Least and largest values are exact.
            _ => return Ok(None),
        };
        let Some((_, input)) = node.op.reads().into_iter().next() else { return Ok(None) };
        // Everything else is left to the pipeline: masks, other stages' results, parts, constant borders.
        let plain =
            run.inputs.iter().any(|i| i.name == input.name) && node.where_.is_none() && run.run.region.is_none();
        if !plain || matches!(node.border, Border::Constant(_)) {
            return Ok(None);
        }
        let lattice = self.lattice(run)?;
        let key = |name: &str| format!("stage.{}.{name}", node.name);
        let windows = match &node.op {
            Op::Box { radius, .. } => {
                Windows::Box { radius: lengths::radius(radius, &lattice, &key("radius"))?, border: node.border }
            }
            Op::Gaussian { sigma, .. } => {
                Windows::Gaussian { sigma: lengths::sigma(sigma, &lattice, &key("sigma"))?, border: node.border }
            }
            Op::OcclusionMap { .. } => {
                Windows::Map { halved: std::array::from_fn(|a| judged_shape[a] < lattice.shape[a]) }
            }
            _ => return Ok(None),
        };
        Ok(Some((windows, moment)))
    }

    /// The lattice of the stage's input.
    fn lattice(&self, run: &Config) -> Result<Lattice> {
        let infos: Vec<_> = open_inputs(run)?.iter().map(|s| s.info().clone()).collect();
        let mut config = run.clone();
        config.run.device = Device::Cpu;
        let plan = Plan::new(&config, &infos, &mut || Err("not looked for".into())).map_err(|e| run.locate(e))?;
        let name = settings::node(run, self.job).and_then(|n| Some(n.op.reads().first()?.1.name.clone()));
        let input = run.inputs.iter().position(|i| Some(&i.name) == name.as_ref());
        let found = plan.graph.lattices.iter().find(|l| Some(l.input) == input).or(plan.graph.lattices.first());
        found.cloned().ok_or_else(|| Error::Failed("the stage reads no volume".into()))
    }

    /// Voxels of the input per cell of an output of this shape.
    pub fn scale(&self, run: &Config, shape: Shape) -> Result<Shape> {
        let map = matches!(settings::node(run, self.job).map(|n| &n.op), Some(Op::OcclusionMap { .. }));
        if !map {
            return Ok([1; 3]);
        }
        let whole = match run.run.region {
            Some(r) => r.map(|[lo, hi]| (hi - lo) as usize),
            None => self.lattice(run)?.shape,
        };
        Ok(std::array::from_fn(|a| whole[a].div_ceil(shape[a])))
    }

    /// Finds the truth of a run whose output has this shape.
    pub fn truth(&self, run: &Config, settings: Table, shape: Shape, index: usize) -> Result<Truth> {
        let judged = Judged::choose(shape, self.job.sample, self.job.seed);
        let scale = self.scale(run, shape)?;
        let path = self.job.folder.join(format!("reference{index}.zarr"));
        let start = Instant::now();
        let (path, by, config) = match self.means(run, &settings, shape, &path)? {
            Means::Run(config) => {
                once(&config, cost::boxes(&judged, &config, scale).as_deref(), self.cancel)?;
                (path, "pipeline", *config)
            }
            Means::TwoPass { windows, moment } => {
                let path = path.with_extension("npy");
                self.two_pass(run, &windows, moment, shape, &judged, &path)?;
                (path, "two passes in f64", run.clone())
            }
        };
        let seconds = start.elapsed().as_secs_f64();
        let spread = self.job.folder.join(format!("spread{index}.zarr"));
        let helper = spread_of(&config, &self.job.stage.name, &spread);
        if let Some(helper) = &helper {
            once(helper, cost::boxes(&judged, helper, scale).as_deref(), self.cancel)?;
        }
        Ok(Truth { settings, path, spread: helper.map(|_| spread), judged, by, seconds })
    }

    /// Writes moments by two passes, of the judged bricks, as `.npy`.
    fn two_pass(
        &self,
        run: &Config,
        windows: &Windows,
        moment: Moment,
        shape: Shape,
        judged: &Judged,
        path: &Path,
    ) -> Result<()> {
        let volume = input_of(run, self.job, self.cancel)?;
        let extent = volume.info().shape;
        let (file, head) = create_npy(path, shape)?;
        let whole = Region::whole(shape);
        let all = || whole.cells([0; 3], [EDGE; 3]).iter().map(|c| Region::of_cell(c, [0; 3], [EDGE; 3]).clip(&whole));
        let cells: Vec<Region> = judged.cells.clone().unwrap_or_else(|| all().collect());
        let one = |cell: Region| {
            self.cancel.check()?;
            let seen = windows.sees(cell, extent);
            let values = windows.moments(cell, moment, &read_box(&volume, 0, seen)?, seen, extent);
            let [_, ny, nx] = cell.shape();
            for (i, row) in values.chunks_exact(nx).enumerate() {
                let (z, y) = (cell.lo[0] as usize + i / ny, cell.lo[1] as usize + i % ny);
                let place = head + 8 * ((z * shape[1] + y) * shape[2] + cell.lo[2] as usize) as u64;
                let bytes: Vec<u8> = row.iter().flat_map(|v| v.to_le_bytes()).collect();
                file.write_all_at(&bytes, place).map_err(|e| Error::file(path, format!("cannot write: {e}")))?;
            }
            Ok(())
        };
        cells.into_par_iter().try_for_each(one)
    }

    /// The gradient's magnitude of the stage's input, where it is judged; `None` where there is no gradient.
    pub fn gradient(&self, run: &Config, judged: &Judged, scale: Shape) -> Result<Option<PathBuf>> {
        let path = self.job.folder.join("gradient.zarr");
        let Some(config) = gradient_of(run, &self.job.stage.name, &path) else { return Ok(None) };
        // A lattice of its own, as occlusion maps may have, is not the input's.
        if scale != [1; 3] {
            return Ok(None);
        }
        match once(&config, cost::boxes(judged, &config, scale).as_deref(), self.cancel) {
            Ok(_) => Ok(Some(path)),
            // Inputs of several components have none.
            Err(Error::Config { .. }) => Ok(None),
            Err(e) => Err(e),
        }
    }
}

impl Truth {
    pub fn remove(&self) {
        std::iter::once(&self.path).chain(&self.spread).for_each(|p| cost::remove(p));
    }

    pub fn json(&self) -> serde_json::Value {
        json!({"settings": self.settings, "by": self.by, "seconds": self.seconds, "judged": self.judged.json()})
    }
}

/// Whether a reference asks for the exact count and nothing else. Such a truth is made without the text of the config, where
/// keys of the method that is varied may stand.
fn only_counts(reference: &Table) -> bool {
    reference.len() == 1 && reference.get("method").and_then(Value::as_str) == Some("exact")
}

/// The input that a stage reads, with what the config says of it.
fn input_of(run: &Config, job: &Pareto, cancel: &Cancel) -> Result<Volume> {
    let name = settings::node(run, job).and_then(|n| Some(n.op.reads().first()?.1.name.clone()));
    let input = run.inputs.iter().find(|i| Some(&i.name) == name.as_ref());
    let input = input.ok_or_else(|| Error::Failed("the stage reads no input of the config".into()))?;
    Volume::of_input(input, &job.folder, cancel)
}

/// An empty f64 array, and where its values start.
fn create_npy(path: &Path, [nz, ny, nx]: Shape) -> Result<(File, u64)> {
    let mut head = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({nz}, {ny}, {nx}), }}");
    while !(10 + head.len() + 1).is_multiple_of(64) {
        head.push(' ');
    }
    head.push('\n');
    let bytes = [b"\x93NUMPY\x01\x00", &(head.len() as u16).to_le_bytes()[..], head.as_bytes()].concat();
    let failed = |e| Error::file(path, format!("cannot write: {e}"));
    let mut file = File::create(path).map_err(failed)?;
    file.write_all(&bytes).map_err(failed)?;
    // Bricks that are not judged stay holes.
    file.set_len(bytes.len() as u64 + 8 * (nz * ny * nx) as u64).map_err(failed)?;
    Ok((file, bytes.len() as u64))
}

/// A run of `variant` (whose one output is measured) that writes the gradient's magnitude of the stage's input instead.
fn gradient_of(variant: &Config, stage: &str, path: &Path) -> Option<Config> {
    let node = variant.stages.iter().find(|s| s.name == stage)?;
    let input = node.op.reads().first()?.1.clone();
    let op = Op::Gradient { input, size: 3, weight: GradientWeight::Inverse };
    Some(helper(variant, node, op, "magnitude", Border::Nearest, path))
}

/// The same for the windows' standard deviation; `None` for stages without box windows.
fn spread_of(variant: &Config, stage: &str, path: &Path) -> Option<Config> {
    let node = variant.stages.iter().find(|s| s.name == stage)?;
    let (Op::AmbientOcclusion { input, radius, .. } | Op::Box { input, radius }) = &node.op else { return None };
    let op = Op::Box { input: input.clone(), radius: radius.clone() };
    Some(helper(variant, node, op, "std", node.border, path))
}

fn helper(variant: &Config, node: &StageNode, op: Op, channel: &str, border: Border, path: &Path) -> Config {
    let mut config = variant.clone();
    config.run.device = Device::Cpu;
    let stage = StageNode { name: HELPER.into(), op, border, where_: None, fill: None, place: node.place.clone() };
    config.stages.push(stage);
    for output in &mut config.outputs {
        output.from = vec![Ref { name: HELPER.into(), channel: Some(channel.into()) }];
        output.path = path.to_path_buf();
        output.dtype = Some(OutputDType::Native);
    }
    config
}

/// A volume that may lack what is not judged.
pub fn open(path: &Path, cancel: &Cancel) -> Result<Volume> {
    Volume::open_part(path, &RawArgs::default(), cancel)
}
