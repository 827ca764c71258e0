//! Where an output lies and how it is stored: what every output takes from its lattice and from its table of the config.

use crate::config::{Config, Output, OutputFormat};
use crate::grid::{DType, Region};
use crate::plan::graph::Lattice;
use crate::store::{Pyramid, SinkSpec, VolumeInfo};
use crate::{Error, Result};

/// The part of a lattice that level 0 of an output covers.
pub(super) struct Ground<'a> {
    output: &'a Output,
    info: &'a VolumeInfo,
    lattice: &'a Lattice,
    /// In voxels of the input.
    pub region: Region,
    /// Of the region's first voxel, in physical units.
    origin: [f64; 3],
}

/// What the arrays of an output hold.
pub(super) struct Contents {
    pub dtype: DType,
    /// As stored.
    pub fill: f64,
    /// One per component.
    pub names: Vec<String>,
    /// Whether there is an axis `c`.
    pub several: bool,
    /// Of the levels, in metadata.
    pub reduce: &'static str,
}

impl<'a> Ground<'a> {
    pub fn of(
        config: &Config,
        output: &'a Output,
        infos: &'a [VolumeInfo],
        lattice: &'a Lattice,
    ) -> Result<Ground<'a>> {
        let region = region_of(config, lattice.shape)?;
        let origin = std::array::from_fn(|a| lattice.origin[a] + region.lo[a] as f64 * lattice.spacing[a]);
        Ok(Ground { output, info: &infos[lattice.input], lattice, region, origin })
    }

    /// Levels that the output has: as many as were asked for (`None`: until one chunk holds the level); only Zarr has more than one.
    pub fn levels(&self) -> Option<usize> {
        let zarr = matches!(self.output.format, OutputFormat::OmeZarr04 | OutputFormat::OmeZarr05);
        if zarr { self.output.levels } else { Some(1) }
    }

    pub fn pyramid(&self, levels: Option<usize>, stride: bool) -> Pyramid {
        Pyramid::new(self.region.shape(), self.lattice.spacing, self.origin, self.output.chunk, levels, stride)
    }

    pub fn spec(&self, pyramid: Pyramid, contents: Contents) -> SinkSpec {
        let output = self.output;
        SinkSpec {
            name: output.name.clone(),
            path: output.path.clone(),
            format: output.format,
            dtype: contents.dtype,
            fill: contents.fill,
            pyramid,
            components: contents.several.then_some(contents.names.len()),
            component_names: contents.names,
            chunk: output.chunk,
            shard: output.shard,
            codec: output.codec,
            unit: self.lattice.unit.clone(),
            orientation: self.info.orientation.clone(),
            region_start: self.region.lo,
            reduce_name: contents.reduce.into(),
        }
    }
}

fn region_of(config: &Config, shape: [usize; 3]) -> Result<Region> {
    let whole = Region::whole(shape);
    let Some(r) = config.run.region else { return Ok(whole) };
    let lo = r.map(|[lo, _]| i64::try_from(lo).unwrap_or(i64::MAX));
    let hi = r.map(|[_, hi]| i64::try_from(hi).unwrap_or(i64::MAX));
    let region = Region::new(lo, hi);
    if region.is_empty() || !whole.contains(&region) {
        let message = format!("{r:?} does not lie inside the volume of {shape:?} voxels (z, y, x; half-open)");
        return Err(config.locate(Error::config("run.region", message)));
    }
    Ok(region)
}
