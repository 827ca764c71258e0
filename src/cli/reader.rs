//! Volumes for commands that look at all of one or at a few slices: planes of scaled `f64` values, missing voxels as NaN.
//!
//! Planes are read in order. A chunked volume is decoded one row of chunks at a time (all chunks of one z index) and kept
//! as decoded, in its stored type; so nothing is decoded twice, and memory is one such row.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::args::RawArgs;
use super::attributes::{self, Attributes};
use super::progress::Count;
use super::{messages, usage};
use crate::brick::{Voxels, gather};
use crate::config::{Input, InputKind, Place, RawFormat, Select};
use crate::grid::{Affine, DType, Region, Shape, Voxel};
use crate::run::Cancel;
use crate::store::source::ChunkRead;
use crate::store::{Orientation, Source, VolumeInfo};
use crate::{Error, Result, with_voxels};

/// More voxels than this are not held at once.
const MAX_HELD: usize = 1 << 31;

/// An open volume with what is known about its values.
pub struct Volume {
    pub path: PathBuf,
    pub source: Source,
    pub attributes: Attributes,
    /// Stored to scaled values: the recorded value range where there is one, else the file's slope and intercept.
    pub affine: Affine,
}

/// The input that a path on the command line means: all channels, first time step.
fn input(path: &Path, level: usize, raw: &RawArgs) -> Result<Input> {
    let headerless = match (raw.shape, raw.dtype) {
        (Some(shape), Some(dtype)) => {
            let (big_endian, offset) = (raw.big_endian, raw.offset);
            Some(RawFormat { shape, dtype, big_endian, offset, trailing_ignore: false, components: 1 })
        }
        (None, None) => None,
        _ => return Err(usage("--shape", "a headerless volume needs both --shape and --dtype")),
    };
    Ok(Input {
        name: path.display().to_string(),
        place: Place::default(),
        kind: InputKind::Path { path: path.to_path_buf(), raw: headerless },
        level,
        array: None,
        channel: Select::All,
        time: Select::Index(0),
        spacing: None,
        unit: None,
        origin: None,
        slope: None,
        intercept: None,
        nodata: None,
    })
}

/// A key of the input that stands for the command line is a flag there.
fn of_flag(path: &Path, error: Error) -> Error {
    match error {
        Error::Config { key, message, .. } => match key.strip_prefix(&format!("input.{}.", path.display())) {
            Some(name) => usage(&format!("--{name}"), &message),
            None => Error::config(key, message),
        },
        other => other,
    }
}

impl Volume {
    /// Opens a volume and makes its voxels readable (gzip is unpacked into a nameless file of the temporary folder).
    pub fn open(path: &Path, level: usize, raw: &RawArgs, cancel: &Cancel) -> Result<Volume> {
        let volume = Volume::open_level(path, level, raw, cancel)?;
        if volume.attributes.complete() == Some(false) {
            messages::warning(&format!("{}: this output was not finished", path.display()));
        }
        Ok(volume)
    }

    /// Level 0 of an output that may be unfinished, of which only what was written is looked at.
    pub fn open_part(path: &Path, raw: &RawArgs, cancel: &Cancel) -> Result<Volume> {
        Volume::open_level(path, 0, raw, cancel)
    }

    /// An input of a config, with its overrides; what has to be unpacked goes to `folder`.
    pub fn of_input(given: &Input, folder: &Path, cancel: &Cancel) -> Result<Volume> {
        let path = given.kind.path().unwrap_or(Path::new(&given.name));
        let mut source = Source::open(given)?;
        source.prepare(folder, &|_| !cancel.is_cancelled())?;
        cancel.check()?;
        Ok(Volume::new(path, source, Attributes::default()))
    }

    fn open_level(path: &Path, level: usize, raw: &RawArgs, cancel: &Cancel) -> Result<Volume> {
        let attributes = attributes::read(path);
        let mut source = Source::open(&described(path, level, raw, &attributes)?).map_err(|e| of_flag(path, e))?;
        source.prepare(&std::env::temp_dir(), &|_| !cancel.is_cancelled())?;
        cancel.check()?;
        Ok(Volume::new(path, source, attributes))
    }

    fn new(path: &Path, source: Source, attributes: Attributes) -> Volume {
        let info = source.info();
        let affine = recorded(info.dtype, &attributes).unwrap_or(info.affine);
        Volume { path: path.to_path_buf(), source, attributes, affine }
    }

    pub fn info(&self) -> &VolumeInfo {
        self.source.info()
    }

    /// Of the file, or what an output recorded of its input's.
    pub fn orientation(&self) -> Option<Orientation> {
        self.info().orientation.clone().or_else(|| self.attributes.orientation())
    }

    pub fn planes(&self, component: usize) -> Result<Planes<'_>> {
        Planes::new(&self.source, self.affine, component)
    }

    /// Goes through the planes of a component in order, until somebody asks to stop.
    pub fn each_plane(
        &self,
        component: usize,
        cancel: &Cancel,
        count: &mut Count,
        f: &mut dyn FnMut(&[f64]),
    ) -> Result<()> {
        let mut planes = self.planes(component)?;
        let mut plane = vec![0.0; planes.plane_voxels()];
        while planes.next(&mut plane)? {
            cancel.check()?;
            f(&plane);
            count.add(plane.len());
        }
        Ok(())
    }
}

/// [`input`] of a path with what is known beside it.
pub fn described(path: &Path, level: usize, raw: &RawArgs, attributes: &Attributes) -> Result<Input> {
    let own = raw.shape.is_none();
    let raw = describe(path, raw, attributes);
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let stem = name.strip_suffix(".gz").unwrap_or(&name);
    if raw.shape.is_none() && path.is_file() && (stem.ends_with(".raw") || stem.ends_with(".bin")) {
        let message = format!("{} is headerless; expected --shape Z,Y,X and --dtype beside it", path.display());
        return Err(usage("--shape", message));
    }
    let mut input = input(path, level, &raw)?;
    if attributes.components.is_some() {
        // NIfTI keeps the components of an output as times.
        input.time = Select::All;
    }
    // Formats that cannot say it themselves.
    if ["raw", "npy"].iter().any(|e| path.extension().is_some_and(|x| x.eq_ignore_ascii_case(e)))
        && let Some((spacing, unit)) = attributes.spacing()
    {
        (input.spacing, input.unit) = (Some(spacing), unit);
    }
    if let (InputKind::Path { raw: Some(raw), .. }, true) = (&mut input.kind, own) {
        raw.components = attributes.components.unwrap_or(1);
    }
    Ok(input)
}

/// A headerless output of this program: shape and type stand in the file beside it.
fn describe(path: &Path, given: &RawArgs, attributes: &Attributes) -> RawArgs {
    let raw_name = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("raw"));
    match (attributes.shape, given.dtype.or(attributes.dtype)) {
        (Some(shape), Some(dtype)) if raw_name && given.shape.is_none() => {
            RawArgs { shape: Some(shape), dtype: Some(dtype), ..given.clone() }
        }
        _ => given.clone(),
    }
}

/// Codes of an integer output to values.
fn recorded(dtype: DType, attributes: &Attributes) -> Option<Affine> {
    let [lo, hi] = attributes.value_range().filter(|_| matches!(dtype, DType::U8 | DType::U16))?;
    Some(Affine { slope: (hi - lo) / dtype.range().1, intercept: lo })
}

/// Decoded chunks of one z index.
struct ChunkRow {
    z: i64,
    /// Chunks per axis y and x; x fastest below.
    grid: [usize; 2],
    chunks: Vec<Chunk>,
}

enum Chunk {
    Missing(f64),
    Data(Voxels),
}

/// The planes of one component, in order.
pub struct Planes<'a> {
    source: &'a Source,
    to_value: ToValue,
    component: usize,
    shape: Shape,
    next: usize,
    row: Option<ChunkRow>,
    stored: Voxels,
}

/// Stored to scaled values, missing ones to NaN.
#[derive(Clone, Copy)]
struct ToValue {
    affine: Affine,
    nodata: Option<f64>,
}

impl ToValue {
    fn apply<T: Voxel>(self, stored: &[T], values: &mut [f64]) {
        for (value, s) in values.iter_mut().zip(stored) {
            let s = s.to_f64();
            *value = if self.nodata == Some(s) { f64::NAN } else { self.affine.apply(s) };
        }
    }

    fn one(self, stored: f64) -> f64 {
        if self.nodata == Some(stored) { f64::NAN } else { self.affine.apply(stored) }
    }
}

/// Voxels of a box, or the refusal to hold so many.
fn held(shape: Shape) -> Result<usize> {
    let voxels = shape.iter().try_fold(1usize, |n, &e| n.checked_mul(e)).filter(|&n| n <= MAX_HELD);
    voxels.ok_or_else(|| {
        Error::Failed(format!(
            "{} voxels are too many to hold at once; a coarser level may do",
            super::human::extent(shape)
        ))
    })
}

impl<'a> Planes<'a> {
    fn new(source: &'a Source, affine: Affine, component: usize) -> Result<Planes<'a>> {
        let info = source.info();
        let [_, y, x] = info.shape;
        let plane = held([1, y, x])?;
        let stored = Voxels::zeroed(info.dtype, if info.chunk.is_none() { plane } else { 0 });
        let to_value = ToValue { affine, nodata: info.nodata };
        Ok(Planes { source, to_value, component, shape: info.shape, next: 0, row: None, stored })
    }

    /// Values of one plane.
    pub fn plane_voxels(&self) -> usize {
        self.shape[1] * self.shape[2]
    }

    /// Fills `plane` (y rows of x) with the next plane; false after the last.
    pub fn next(&mut self, plane: &mut [f64]) -> Result<bool> {
        let [nz, ny, nx] = self.shape;
        let z = self.next;
        if z >= nz {
            return Ok(false);
        }
        let region = Region::new([z as i64, 0, 0], [z as i64 + 1, ny as i64, nx as i64]);
        match self.source.info().chunk {
            None => {
                self.source.read(self.component, region, self.stored.view_mut([1, ny, nx]))?;
                let to_value = self.to_value;
                with_voxels!(&self.stored, v => to_value.apply(v, plane));
                self.source.release(region);
            }
            Some(chunk) => {
                let row = (z / chunk[0]) as i64;
                if self.row.as_ref().is_none_or(|r| r.z != row) {
                    self.row = None;
                    self.row = Some(self.decode(row, chunk)?);
                }
                if let Some(row) = &self.row {
                    copy_plane(row, chunk, z % chunk[0], [ny, nx], self.to_value, plane);
                }
            }
        }
        self.next += 1;
        Ok(true)
    }

    fn decode(&self, z: i64, chunk: Shape) -> Result<ChunkRow> {
        let grid = [self.shape[1].div_ceil(chunk[1]), self.shape[2].div_ceil(chunk[2])];
        held([chunk[0], grid[0] * chunk[1], grid[1] * chunk[2]])?;
        let one = |i: usize| decode_chunk(self.source, self.component, [z, (i / grid[1]) as i64, (i % grid[1]) as i64]);
        let chunks = (0..grid[0] * grid[1]).into_par_iter().map(one).collect::<Result<Vec<_>>>()?;
        Ok(ChunkRow { z, grid, chunks })
    }
}

fn decode_chunk(source: &Source, component: usize, index: [i64; 3]) -> Result<Chunk> {
    let info = source.info();
    let voxels = held(info.chunk.unwrap_or(info.shape))?;
    let mut data = Voxels::zeroed(info.dtype, voxels);
    Ok(match source.read_chunk(component, index, &mut data)? {
        ChunkRead::Missing(value) => Chunk::Missing(value),
        ChunkRead::Data { .. } => Chunk::Data(data),
    })
}

/// Plane `z` inside a row of chunks.
fn copy_plane(row: &ChunkRow, chunk: Shape, z: usize, [ny, nx]: [usize; 2], to_value: ToValue, plane: &mut [f64]) {
    for (y, line) in plane.chunks_exact_mut(nx).take(ny).enumerate() {
        for (cx, part) in line.chunks_mut(chunk[2]).enumerate() {
            match &row.chunks[(y / chunk[1]) * row.grid[1] + cx] {
                Chunk::Missing(value) => part.fill(to_value.one(*value)),
                Chunk::Data(voxels) => {
                    let start = (z * chunk[1] + y % chunk[1]) * chunk[2];
                    with_voxels!(voxels, v => to_value.apply(&v[start..start + part.len()], part));
                }
            }
        }
    }
}

/// Scaled values of a box inside the volume; for a few slices, since chunks are not kept.
pub fn read_box(volume: &Volume, component: usize, region: Region) -> Result<Vec<f64>> {
    let info = volume.info();
    let shape = region.shape();
    let mut values = vec![0.0; held(shape)?];
    let mut stored = Voxels::zeroed(info.dtype, values.len());
    match info.chunk {
        None => _ = volume.source.read(component, region, stored.view_mut(shape))?,
        Some(chunk) => {
            for index in region.cells([0; 3], chunk).iter() {
                let cell = Region::of_cell(index, [0; 3], chunk);
                let part = stored.view_mut(shape);
                match decode_chunk(&volume.source, component, index)? {
                    Chunk::Missing(value) => gather::fill_common(value, cell, part, region),
                    Chunk::Data(voxels) => gather::copy_common(voxels.view(chunk), cell, part, region),
                }
            }
        }
    }
    let to_value = ToValue { affine: volume.affine, nodata: info.nodata };
    with_voxels!(&stored, v => to_value.apply(v, &mut values));
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_come_out_of_chunks_whole() {
        // 3 x 5 voxels in chunks of [2, 2, 3]; plane 1 of the row.
        let chunk = [2, 2, 3];
        let at = |z: usize, y: usize, x: usize| (100 * z + 10 * y + x) as u16;
        let data = |cy: usize, cx: usize| {
            let voxel = |i: usize| at(i / 6, cy * 2 + i / 3 % 2, cx * 3 + i % 3);
            Chunk::Data(Voxels::U16((0..12).map(voxel).collect()))
        };
        let chunks = vec![data(0, 0), data(0, 1), Chunk::Missing(7.0), data(1, 1)];
        let row = ChunkRow { z: 0, grid: [2, 2], chunks };
        let to_value = ToValue { affine: Affine { slope: 2.0, intercept: 1.0 }, nodata: Some(113.0) };
        let mut plane = vec![0.0; 15];
        copy_plane(&row, chunk, 1, [3, 5], to_value, &mut plane);
        for (i, value) in plane.iter().enumerate() {
            let (y, x) = (i / 5, i % 5);
            let stored = if y == 2 && x < 3 { 7.0 } else { f64::from(at(1, y, x)) };
            if stored == 113.0 {
                assert!(value.is_nan());
            } else {
                assert_eq!(*value, 2.0 * stored + 1.0, "{y} {x}");
            }
        }
    }

    #[test]
    fn recorded_ranges_are_for_codes_only() {
        let attributes =
            Attributes { occlude: Some(serde_json::json!({"value_range": [-1.0, 1.0]})), ..Attributes::default() };
        assert_eq!(recorded(DType::U8, &attributes).unwrap().apply(255.0), 1.0);
        assert_eq!(recorded(DType::U16, &attributes).unwrap().apply(0.0), -1.0);
        assert_eq!(recorded(DType::F32, &attributes), None);
        assert_eq!(recorded(DType::U8, &Attributes::default()), None);
        assert!(held([1 << 20, 1 << 20, 1 << 20]).is_err());
    }
}
