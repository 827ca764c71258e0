//! Volumes that can be read: anything that reports a lattice and fills a box of it.
//!
//! A header parser (`raw`, `nifti`, `nrrd`, `metaimage`, `tiff`) says where the voxels lie; `planar` maps the file, or
//! unpacks it once, and `lattice` copies boxes. `zarr` reads chunk by chunk, `synthetic` computes.

mod bytes;
mod chunk_codecs;
mod detect;
mod flat;
mod identity;
mod lattice;
mod metaimage;
mod nifti;
mod nrrd;
mod parts;
mod planar;
mod raw;
mod reblock;
mod shards;
mod spool;
mod synthetic;
mod tiff;
mod tiff_text;
mod transposed;
pub mod units;
mod zarr;
mod zarr_meta;

use std::ops::Range;
use std::path::{Path, PathBuf};

use super::VolumeInfo;
use crate::brick::Voxels;
use crate::config::{Input, InputKind};
use crate::grid::{Affine, AnyViewMut, DType, Region, Shape, Voxel};
use crate::kernel::simd::Level;
use crate::{Error, Result};
use detect::Format;
use flat::Unpacked;
use lattice::Lattice;
use planar::{Planar, key};

/// An open volume. Reading needs only `&self` and is safe from several threads.
#[derive(Debug)]
pub struct Source {
    info: VolumeInfo,
    kind: Kind,
    level: Level,
    /// Of a Zarr array that is read from scratch: `None` until it is there.
    flat: Option<Option<Unpacked>>,
    /// Planes of a Zarr array that will be read.
    planes: Range<usize>,
}

#[derive(Debug)]
enum Kind {
    Planar(Planar),
    Zarr(Box<zarr::ZarrArray>),
    Synthetic(synthetic::Field),
}

/// Outcome of [`Source::read_chunk`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ChunkRead {
    /// The chunk is not stored: every voxel has this stored value (NaN where that is a float's nodata).
    Missing(f64),
    /// Decoded; so many bytes were read from storage.
    Data { stored_bytes: u64 },
}

impl Source {
    /// Opens a volume and reads its header, nothing more.
    pub fn open(input: &Input) -> Result<Source> {
        let (info, kind) = match &input.kind {
            InputKind::Synthetic { field, shape, dtype, seed } => {
                let (info, field) = synthetic::open(input, field, *shape, *dtype, *seed)?;
                (info, Kind::Synthetic(field))
            }
            InputKind::Path { path, raw } => open_path(input, path, raw.as_ref())?,
        };
        let info = overridden(info, input)?;
        let planes = 0..info.shape[0];
        Ok(Source { info, kind, level: Level::detect(), flat: None, planes })
    }

    /// A volume in memory. Panics if `voxels` does not have the shape's size or the shape is empty.
    pub fn from_array(shape: Shape, voxels: Voxels) -> Source {
        assert_eq!(voxels.len(), shape.iter().product::<usize>(), "{shape:?} voxels are expected");
        assert!(!voxels.is_empty(), "a volume has at least one voxel");
        let info = VolumeInfo::plain(shape, voxels.dtype(), "memory");
        let big = cfg!(target_endian = "big");
        let lattice = Lattice::dense(shape, voxels.dtype(), big, 0).expect("the voxels fit in memory");
        let planes = 0..info.shape[0];
        let kind = Kind::Planar(Planar::memory(lattice, voxels));
        Source { info, kind, level: Level::detect(), flat: None, planes }
    }

    /// A volume in memory, copied from an array of axes z, y, x in any memory order. Panics if it is empty.
    pub fn from_ndarray<T: Voxel>(array: ndarray::ArrayView3<T>) -> Source
    where
        Voxels: From<Vec<T>>,
    {
        let (z, y, x) = array.dim();
        Source::from_array([z, y, x], array.iter().copied().collect::<Vec<T>>().into())
    }

    /// As [`Source::from_array`], with facts of the caller's; `info` keeps the array's shape and type.
    pub fn from_array_with(info: VolumeInfo, voxels: Voxels) -> Source {
        let mut source = Source::from_array(info.shape, voxels);
        let dtype = source.info.dtype;
        source.info = VolumeInfo { dtype, components: 1, chunk: None, ..info };
        source
    }

    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    /// Reads a Zarr array by planes from scratch, once prepared, where its chunks are so flat or large that a run of this
    /// budget would decode them again and again. The volume then has no chunks.
    pub fn flatten(&mut self, memory: u64) {
        if flat::is_flat(&self.info, memory) {
            self.unpack_first();
        }
    }

    /// Reads a Zarr array by planes from scratch, once prepared. The volume then has no chunks.
    pub fn unpack_first(&mut self) {
        if matches!(self.kind, Kind::Zarr(_)) && self.flat.is_none() {
            self.info.chunk = None;
            self.flat = Some(None);
        }
    }

    /// Bytes that [`Source::prepare`] read from a Zarr array; what is read from scratch then is not counted again.
    pub fn unpacked_bytes(&self) -> u64 {
        self.flat.iter().flatten().map(|f| f.read).sum()
    }

    /// The value of a box inside a volume that was unpacked first, where nothing of it was stored.
    pub fn absent_box(&self, component: usize, region: Region) -> Option<f64> {
        let flat = self.flat.as_ref()?.as_ref()?;
        flat.absent_box(component, region).map(|fill| self.fill(fill))
    }

    /// Says that no other planes (along z) will be read: [`Source::prepare`] unpacks no more than those.
    pub fn narrow(&mut self, planes: Range<usize>) {
        match &mut self.kind {
            Kind::Planar(planar) => planar.narrow(planes),
            Kind::Zarr(_) => self.planes = planes,
            Kind::Synthetic(_) => {}
        }
    }

    /// Bytes of scratch disk that [`Source::prepare`] needs (0 for sources that are read in place).
    pub fn spool_bytes(&self) -> u64 {
        match &self.kind {
            Kind::Planar(planar) => planar.spool_bytes(),
            Kind::Zarr(_) if matches!(self.flat, Some(None)) => flat::bytes(&self.info, &self.planes),
            Kind::Zarr(_) | Kind::Synthetic(_) => 0,
        }
    }

    /// Makes the voxels addressable: unpacks gzip or re-blocks compressed planes once, streaming, into `scratch`
    /// (an existing folder). The scratch file has no name, so nothing is left behind even after a kill. `progress` is
    /// told the bytes done and may return false to stop. Does nothing the second time.
    pub fn prepare(&mut self, scratch: &Path, progress: &dyn Fn(u64) -> bool) -> Result<()> {
        match &mut self.kind {
            Kind::Planar(planar) => planar.prepare(scratch, progress),
            Kind::Zarr(array) if matches!(self.flat, Some(None)) => {
                self.flat = Some(Some(flat::run(array, &self.info, &self.planes, scratch, progress)?));
                Ok(())
            }
            Kind::Zarr(_) | Kind::Synthetic(_) => Ok(()),
        }
    }

    /// Fills `dst` (shape and stored type of the box) with stored values; float nodata becomes NaN. Returns the bytes read
    /// from storage. Sources with chunks decode every chunk that the box touches: [`Source::read_chunk`] lets the caller
    /// keep them.
    pub fn read(&self, component: usize, region: Region, dst: AnyViewMut) -> Result<u64> {
        self.read_box(component, region, dst, false)
    }

    /// As [`Source::read`] for boxes that overlap what will be read soon: pages of mapped files stay until
    /// [`Source::release`].
    pub fn read_again(&self, component: usize, region: Region, dst: AnyViewMut) -> Result<u64> {
        self.read_box(component, region, dst, true)
    }

    fn read_box(&self, component: usize, region: Region, mut dst: AnyViewMut, keep: bool) -> Result<u64> {
        let inside = Region::whole(self.info.shape).contains(&region) && component < self.info.components;
        if !inside || dst.shape() != region.shape() || dst.dtype() != self.info.dtype {
            return Err(Error::Failed(format!(
                "box {region:?} of component {component} cannot be read from {} component(s) of {:?} {} into {:?} {}",
                self.info.components,
                self.info.shape,
                self.info.dtype,
                dst.shape(),
                dst.dtype()
            )));
        }
        let bytes = match &self.kind {
            Kind::Planar(planar) => planar.read(self.level, component, region, dst.reborrow(), keep)?,
            Kind::Zarr(array) => match &self.flat {
                Some(Some(flat)) => {
                    flat.planes.read(self.level, component, region, dst.reborrow(), keep)?;
                    0
                }
                _ => array.read(component, region, &self.info, dst.reborrow())?,
            },
            Kind::Synthetic(field) => {
                field.read(region, dst.reborrow());
                0
            }
        };
        if let Some(nodata) = self.info.nodata {
            lattice::mark_missing(&mut dst, nodata);
        }
        Ok(bytes)
    }

    /// Decodes one whole chunk (edge chunks have the full chunk shape; voxels beyond the volume are undefined) into `dst`,
    /// which has the stored type and one chunk's voxels. Float nodata becomes NaN.
    pub fn read_chunk(&self, component: usize, chunk: [i64; 3], dst: &mut Voxels) -> Result<ChunkRead> {
        let (Kind::Zarr(array), Some(shape)) = (&self.kind, self.info.chunk) else {
            return Err(Error::Failed(format!("{} has no chunks", self.info.format)));
        };
        let mut read = array.read_chunk(component, chunk, dst)?;
        match &mut read {
            ChunkRead::Missing(fill) => *fill = self.fill(*fill),
            ChunkRead::Data { .. } => {
                if let Some(nodata) = self.info.nodata.filter(|_| self.info.dtype.is_float()) {
                    lattice::mark_missing(&mut dst.view_mut(shape), nodata);
                }
            }
        }
        Ok(read)
    }

    /// What a chunk holds that is not stored; `None` where it is, or where the source has no chunks. Looks at files and
    /// indexes only.
    pub fn absent_chunk(&self, component: usize, chunk: [i64; 3]) -> Result<Option<f64>> {
        let Kind::Zarr(array) = &self.kind else { return Ok(None) };
        Ok(array.absent_chunk(component, chunk)?.map(|fill| self.fill(fill)))
    }

    /// The fill value of a Zarr array as voxels have it: NaN where it is a float's nodata.
    fn fill(&self, fill: f64) -> f64 {
        let missing = self.info.nodata.filter(|_| self.info.dtype.is_float()).is_some_and(|nodata| {
            if self.info.dtype == DType::F32 { fill as f32 == nodata as f32 } else { fill == nodata }
        });
        if missing { f64::NAN } else { fill }
    }

    /// The pages of this box will not be wanted again soon. Acts on boxes of whole z planes of mapped files.
    pub fn release(&self, region: Region) {
        match (&self.kind, &self.flat) {
            (Kind::Planar(planar), _) => planar.release(region),
            (_, Some(Some(flat))) => flat.planes.release(region),
            _ => {}
        }
    }

    /// Size, metadata and hashed samples: changes when the input does, and does not depend on its path.
    pub fn identity(&self) -> Result<serde_json::Value> {
        let info = &self.info;
        match &self.kind {
            Kind::Planar(planar) => planar.identity(&info.format),
            Kind::Zarr(array) => identity::of_zarr(&info.format, array),
            Kind::Synthetic(field) => Ok(serde_json::json!({
                "format": info.format,
                "shape": field.shape,
                "dtype": field.dtype.name(),
                "seed": field.seed,
            })),
        }
    }

    /// Files and folders that the volume is read from.
    pub fn paths(&self) -> Vec<PathBuf> {
        match &self.kind {
            Kind::Planar(planar) => planar.paths.clone(),
            Kind::Zarr(array) => vec![array.folder().to_path_buf()],
            Kind::Synthetic(_) => Vec::new(),
        }
    }
}

fn open_path(input: &Input, path: &Path, raw: Option<&crate::config::RawFormat>) -> Result<(VolumeInfo, Kind)> {
    let format = match raw {
        Some(_) => None,
        None => Some(detect::detect(path)?),
    };
    if format == Some(Format::Zarr) {
        let (info, array) = zarr::open(input, path)?;
        return Ok((info, Kind::Zarr(Box::new(array))));
    }
    if input.level != 0 {
        let text = format!("{}: only OME-Zarr images have levels; {} has level 0", input.level, path.display());
        return Err(Error::config(key(input, "level"), text));
    }
    if let Some(name) = &input.array {
        let text = format!("`{name}`: only Zarr groups have named arrays; {} is none", path.display());
        return Err(Error::config(key(input, "array"), text));
    }
    let parsed = match (raw, format) {
        (Some(raw), _) => raw::open_raw(input, path, raw)?,
        (_, Some(Format::Nifti)) => nifti::open(input, path)?,
        (_, Some(Format::Nrrd)) => nrrd::open(input, path)?,
        (_, Some(Format::MetaImage)) => metaimage::open(input, path)?,
        (_, Some(Format::Tiff)) => tiff::open(input, path)?,
        _ => raw::open_npy(input, path)?,
    };
    let (info, planar) = Planar::new(parsed)?;
    Ok((info, Kind::Planar(planar)))
}

/// Applies what the config says over what the file says, and checks what is used.
fn overridden(mut info: VolumeInfo, input: &Input) -> Result<VolumeInfo> {
    let sane = |v: &f64| v.is_finite() && *v > 0.0;
    if let Some(spacing) = input.spacing {
        if !spacing.iter().all(sane) {
            return Err(Error::config(
                key(input, "spacing"),
                format!("{spacing:?}: three positive numbers, z, y, x, are expected"),
            ));
        }
        info.spacing = spacing;
    }
    if !info.spacing.iter().all(sane) {
        let place = input.kind.path().unwrap_or(Path::new(""));
        let text = format!(
            "the spacing in the header (z, y, x) is {:?}, which is not positive; give the input spacing = [z, y, x]",
            info.spacing
        );
        return Err(Error::file(place, text));
    }
    if let Some(unit) = &input.unit {
        info.unit = units::normalise(unit);
    }
    if let Some(orientation) = &info.orientation {
        info.origin = orientation.straight_origin().unwrap_or([0.0; 3]);
    }
    if let Some(origin) = input.origin {
        if !origin.iter().all(|v| v.is_finite()) {
            return Err(Error::config(
                key(input, "origin"),
                format!("{origin:?}: three numbers, z, y, x, are expected"),
            ));
        }
        info.origin = origin;
        // Outputs that keep the orientation take their origin from its matrix.
        if let Some(orientation) = &mut info.orientation {
            (0..3).for_each(|r| orientation.matrix[r][3] = origin[2 - r]);
        }
    }
    if !info.origin.iter().all(|v| v.is_finite()) {
        info.origin = [0.0; 3];
    }
    if input.slope.is_some() || input.intercept.is_some() {
        let slope = input.slope.unwrap_or(info.affine.slope);
        info.affine = Affine::new(slope, input.intercept.unwrap_or(info.affine.intercept));
    }
    info.nodata = input.nodata.or(info.nodata);
    Ok(info)
}
