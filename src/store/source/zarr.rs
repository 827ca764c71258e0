//! Zarr arrays, v2 and v3, alone or in OME-Zarr groups: read inner chunk by inner chunk.

use std::borrow::Cow;
use std::fs::File;
use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use zarrs::array::codec::CodecChain;
use zarrs::array::{Array, ArrayBytes, ArrayMetadata, ArrayToBytesCodecTraits, CodecOptions};
use zarrs::filesystem::FilesystemStore;

use super::ChunkRead;
use super::chunk_codecs;
use super::planar::key;
use super::planar::{components, shape_of};
use super::shards::{Shard, Shards};
use super::transposed;
use super::units;
use super::zarr_meta::{self, ArrayMeta, Multiscale, ShardMeta};
use crate::brick::Voxels;
use crate::config::Input;
use crate::grid::{Region, Voxel};
use crate::store::os::FileExt;
use crate::store::{VolumeInfo, blosc};
use crate::{Error, Result, with_dtype};

/// An open Zarr array.
pub struct ZarrArray {
    folder: PathBuf,
    pub meta: ArrayMeta,
    array: Array<FilesystemStore>,
    /// Codecs of an inner chunk, but for a transposition.
    codecs: Arc<CodecChain>,
    /// Shape of an inner chunk as it is stored.
    stored: Vec<NonZeroU64>,
    /// Voxels from one to the next along each axis of a stored inner chunk; `None` where they are in the array's order.
    strides: Option<Vec<usize>>,
    fill: f64,
    shards: Shards,
    /// Axes before the space axes, and each component's index along them.
    lead: usize,
    components: Vec<Vec<u64>>,
    /// Chunks of the volume along z, y, x.
    grid: [i64; 3],
    options: CodecOptions,
    /// Chunks are blosc's containers of one component's voxels, in the order of this machine's bytes, and nothing else.
    plain_blosc: bool,
    /// Folders that changed later may have lost chunks.
    opened: SystemTime,
}

impl std::fmt::Debug for ZarrArray {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ZarrArray").field("folder", &self.folder).field("meta", &self.meta).finish_non_exhaustive()
    }
}

/// What an axis before the space axes is.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lead {
    Time,
    Channel,
    Single,
}

/// Finds the array that the input means: the folder itself, its array `name`, or the level of its multiscales.
fn find(input: &Input, folder: &Path) -> Result<(PathBuf, ArrayMeta, Option<Multiscale>)> {
    let mut folder = folder.to_path_buf();
    let mut listed = None;
    if let Some(name) = &input.array {
        let child = zarr_meta::inside(&folder, name).map_err(|_| {
            Error::config(key(input, "array"), format!("`{name}` is no name of an array inside {}", folder.display()))
        })?;
        if zarr_meta::array(&child)?.is_none() && zarr_meta::group(&child)?.is_none() {
            let have = zarr_meta::children(&folder).join(", ");
            let text = format!("`{name}` is not in {}; it has: {have}", folder.display());
            return Err(Error::config(key(input, "array"), text));
        }
        listed = zarr_meta::group(&folder)?
            .and_then(|(attributes, _)| zarr_meta::named(&attributes, name.trim_matches('/')));
        folder = child;
    }
    if let Some(meta) = zarr_meta::array(&folder)? {
        if input.level != 0 {
            let text =
                format!("{}: {} is one array without levels; give the group's path", input.level, folder.display());
            return Err(Error::config(key(input, "level"), text));
        }
        if let (None, Some(parent), Some(name)) = (&listed, folder.parent(), folder.file_name()) {
            let group = zarr_meta::group(parent).ok().flatten();
            listed = group.and_then(|(attributes, _)| zarr_meta::named(&attributes, &name.to_string_lossy()));
        }
        return Ok((folder, meta, listed));
    }
    let Some((attributes, _)) = zarr_meta::group(&folder)? else {
        return Err(Error::file(&folder, "neither a Zarr array nor a Zarr group"));
    };
    let Some((path, multiscale)) = zarr_meta::dataset(input, &folder, &attributes)? else {
        let have = zarr_meta::children(&folder).join(", ");
        return Err(Error::file(
            &folder,
            format!("a Zarr group without multiscales; name an array in it with array = \"..\" (it has: {have})"),
        ));
    };
    match zarr_meta::array(&path)? {
        Some(meta) => Ok((path, meta, Some(multiscale))),
        None => Err(Error::file(&path, "the multiscales name this array, but it does not exist")),
    }
}

/// What the leading axes are, by name or by place (t, c before z, y, x).
fn lead_axes(path: &Path, meta: &ArrayMeta, multiscale: Option<&Multiscale>) -> Result<Vec<Lead>> {
    let n = meta.shape.len();
    let axes = multiscale.map_or(&[][..], |m| &m.axes);
    if !axes.is_empty() && axes.len() != n {
        return Err(Error::file(path, format!("the multiscales have {} axes, the array {n}", axes.len())));
    }
    let kind = |a: usize| -> Option<&str> {
        let (name, kind) = match axes.get(a) {
            Some((name, kind, _)) => (Some(name.as_str()), kind.as_deref()),
            None => (meta.names[a].as_deref(), None),
        };
        match (kind, name) {
            (Some(k @ ("time" | "channel" | "space")), _) => Some(k),
            (_, Some("t" | "time")) => Some("time"),
            (_, Some("c" | "ch" | "channel" | "channels")) => Some("channel"),
            (_, Some("z" | "y" | "x")) => Some("space"),
            _ => None,
        }
    };
    let kinds: Vec<_> = (0..n).map(kind).collect();
    let named = kinds.iter().rposition(|k| matches!(k, Some("time" | "channel"))).map(|a| a + 1);
    let lead = named.unwrap_or(0).max(n.saturating_sub(3));
    if lead >= n || kinds[..lead].contains(&Some("space")) {
        let text = format!(
            "axes {kinds:?}: time and channel are read only where they come before the space axes, of which there may be three"
        );
        return Err(Error::file(path, text));
    }
    let mut out = Vec::new();
    for (a, kind) in kinds[..lead].iter().enumerate() {
        out.push(match kind {
            None if meta.shape[a] == 1 => Lead::Single,
            Some("time") => Lead::Time,
            Some("channel") => Lead::Channel,
            // Unnamed: c next to space, t before it.
            _ if a + 1 == lead => Lead::Channel,
            _ if a + 2 == lead => Lead::Time,
            _ => return Err(Error::file(path, format!("shape {:?} has more axes than t, c, z, y, x", meta.shape))),
        });
    }
    for kind in [Lead::Time, Lead::Channel] {
        if out.iter().zip(&meta.shape).filter(|(l, n)| **l == kind && **n > 1).count() > 1 {
            return Err(Error::file(path, format!("shape {:?} has two {kind:?} axes", meta.shape)));
        }
    }
    Ok(out)
}

/// Says so where the space axes, slowest first, are named otherwise than the end of z, y, x.
fn other_order(meta: &ArrayMeta, multiscale: Option<&Multiscale>, lead: usize) -> Option<String> {
    let name = |a: usize| match multiscale.and_then(|m| m.axes.get(a)) {
        Some((name, ..)) => name,
        None => meta.names[a].as_deref().unwrap_or(""),
    };
    let names: Vec<&str> = (lead..meta.shape.len()).map(name).collect();
    let usual = &["z", "y", "x"][3 - names.len()..];
    let known = names.iter().all(|n| ["z", "y", "x"].contains(n));
    (known && names != usual).then(|| {
        format!(
            "its axes are named {}, slowest first; they are read and written by their place, as {}",
            names.join(", "),
            usual.join(", ")
        )
    })
}

/// Spacing, origin and unit of the space axes.
fn geometry(path: &Path, m: &Multiscale, lead: usize, n: usize, info: &mut VolumeInfo) -> Result<()> {
    let unit = |a: usize| m.axes.get(a).and_then(|axis| axis.2.as_deref());
    let one = (lead..n).find_map(unit);
    info.unit = one.map(str::to_string);
    if let (Some(one), true) = (one, (lead..n).any(|a| unit(a).is_none())) {
        info.warnings.push(format!("some of its axes have no unit: they are taken to be in {one}, as the others are"));
    }
    for a in lead..n {
        let i = 3 - (n - a);
        info.spacing[i] = m.scale.get(a).copied().unwrap_or(1.0);
        info.origin[i] = m.translation.get(a).copied().unwrap_or(0.0);
        if info.shape[i] == 1 && info.spacing[i].partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            info.spacing[i] = 1.0;
        }
        for length in [&mut info.spacing[i], &mut info.origin[i]] {
            *length = units::to_one(*length, one, unit(a).or(one)).map_err(|why| Error::file(path, why))?;
        }
    }
    Ok(())
}

/// Opens a Zarr array or an OME-Zarr image.
pub fn open(input: &Input, path: &Path) -> Result<(VolumeInfo, ZarrArray)> {
    let (folder, mut meta, multiscale) = find(input, path)?;
    meta.text.extend(format!("{multiscale:?}").bytes()); // placement is part of the identity
    let kinds = lead_axes(&folder, &meta, multiscale.as_ref())?;
    let (lead, n) = (kinds.len(), meta.shape.len());
    let tail = |list: &[u64]| -> [u64; 3] {
        let mut zyx = [1; 3];
        zyx[3 - (n - lead)..].copy_from_slice(&list[lead..]);
        zyx
    };
    let shape = shape_of(&folder, tail(&meta.shape), meta.dtype.size())?;
    let chunk = tail(&meta.inner).map(|n| n as usize);
    let count =
        |kind: Lead| kinds.iter().zip(&meta.shape).filter(|(k, _)| **k == kind).map(|(_, n)| *n).max().unwrap_or(1);
    let labels = multiscale.as_ref().map_or(&[][..], |m| &m.labels);
    let (pairs, names) = components(input, count(Lead::Time) as usize, count(Lead::Channel) as usize, labels)?;
    let index = |(t, c): &(usize, usize)| {
        kinds
            .iter()
            .zip(&meta.shape)
            .map(|(kind, n)| match kind {
                Lead::Time if *n > 1 => *t as u64,
                Lead::Channel if *n > 1 => *c as u64,
                _ => 0,
            })
            .collect()
    };
    let components: Vec<Vec<u64>> = pairs.iter().map(index).collect();

    let codec_text = meta
        .codecs
        .iter()
        .filter(|c| !matches!(c.as_str(), "bytes" | "transpose"))
        .cloned()
        .collect::<Vec<_>>()
        .join(" ");
    let sharded = if meta.shard.is_some() { "sharded, " } else { "" };
    let ome = multiscale.as_ref().map_or(String::new(), |m| format!("OME-Zarr {} on ", m.version));
    let codec_text = if codec_text.is_empty() { "uncompressed".to_string() } else { codec_text };
    let mut info = VolumeInfo::plain(shape, meta.dtype, format!("{ome}Zarr v{}, {sharded}{codec_text}", meta.version));
    info.chunk = Some(chunk);
    (info.components, info.component_names) = (components.len(), names);
    info.times = count(Lead::Time) as usize;
    if let Some(m) = &multiscale {
        geometry(&folder, m, lead, n, &mut info)?;
    }
    info.warnings.extend(other_order(&meta, multiscale.as_ref(), lead));

    let failed = |e: String| {
        let read = if e.contains("codec") { chunk_codecs::READ } else { "" };
        Error::file(&folder, format!("the Zarr array cannot be read: {e}{read}"))
    };
    // Files are opened here, under paths of any bytes; the library, which wants UTF-8, only decodes.
    let store = FilesystemStore::new("/").map_err(|e| failed(e.to_string()))?;
    let array = guarded(|| {
        let metadata: ArrayMetadata = serde_json::from_value(meta.value.clone()).map_err(|e| e.to_string())?;
        Array::new_with_metadata(Arc::new(store), "/", metadata).map_err(|e| e.to_string())
    })
    .map_err(failed)?;
    let codecs = match &meta.shard {
        None => array.codecs(),
        Some(shard) => {
            let list = serde_json::from_value::<Vec<_>>(shard.codecs.clone()).map_err(|e| failed(e.to_string()))?;
            Arc::new(guarded(|| CodecChain::from_metadata(&list).map_err(|e| e.to_string())).map_err(failed)?)
        }
    };
    let fill = with_dtype!(meta.dtype, T => {
        let bytes = array.fill_value().as_ne_bytes();
        if bytes.len() != size_of::<T>() {
            return Err(failed(format!("the fill value has {} bytes", bytes.len())));
        }
        let little = cfg!(target_endian = "little");
        if little { T::from_le_slice(bytes) } else { T::from_be_slice(bytes) }.to_f64()
    });
    let (codecs, order) = guarded(|| Ok(transposed::take(codecs))).map_err(failed)?;
    let inner: Vec<NonZeroU64> = meta.inner.iter().filter_map(|n| NonZeroU64::new(*n)).collect();
    let stored = order.as_ref().map_or(inner.clone(), |order| transposed::stored_shape(&inner, order));
    let strides = order.map(|order| transposed::strides(&meta.inner, &order));
    let grid = std::array::from_fn(|a| shape[a].div_ceil(chunk[a]) as i64);
    let options = CodecOptions::default().with_concurrent_target(1);
    let shards = Shards::default();
    // A server's clock may run ahead of this machine's.
    let touched = folder.metadata().and_then(|m| m.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
    let opened = touched.max(SystemTime::now());
    let plain_blosc = meta.packings.is_empty() && meta.inner[..lead].iter().all(|n| *n == 1) && meta.is_plain_blosc();
    Ok((
        info,
        ZarrArray {
            folder,
            meta,
            array,
            codecs,
            stored,
            strides,
            fill,
            shards,
            lead,
            components,
            grid,
            options,
            plain_blosc,
            opened,
        },
    ))
}

/// Runs a call into the Zarr library; a panic there (broken metadata or data) becomes an error.
fn guarded<R>(f: impl FnOnce() -> Result<R, String>) -> Result<R, String> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(f))
        .unwrap_or_else(|_| Err("the data are corrupt".to_string()))
}

impl ZarrArray {
    /// Folder of the array.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// File of an outer chunk or shard.
    pub fn file_of(&self, outer: &[u64]) -> PathBuf {
        self.folder.join(self.array.chunk_key(outer).as_str())
    }

    /// Outer chunks (files) per axis.
    pub fn outer_grid(&self) -> Vec<u64> {
        self.meta.shape.iter().zip(&self.meta.outer).map(|(n, c)| n.div_ceil(*c)).collect()
    }

    /// Voxels of a chunk, z, y, x.
    pub fn chunk(&self) -> [usize; 3] {
        let tail = &self.meta.inner[self.lead..];
        let mut zyx = [1; 3];
        zyx[3 - tail.len()..].iter_mut().zip(tail).for_each(|(e, n)| *e = *n as usize);
        zyx
    }

    /// Index of the inner chunk in the whole array.
    fn index(&self, component: usize, chunk: [i64; 3]) -> Result<Vec<u64>> {
        let fits = (0..3).all(|a| (0..self.grid[a]).contains(&chunk[a]));
        let lead = self.components.get(component).filter(|_| fits).ok_or_else(|| {
            Error::Failed(format!("chunk {chunk:?} of component {component} is outside the grid {:?}", self.grid))
        })?;
        let n = self.meta.shape.len();
        let mut index: Vec<u64> = lead.iter().zip(&self.meta.inner).map(|(i, c)| i / c).collect();
        index.extend(chunk[3 - (n - self.lead)..].iter().map(|i| *i as u64));
        Ok(index)
    }

    /// Decodes one inner chunk into `dst`; see [`super::Source::read_chunk`].
    pub fn read_chunk(&self, component: usize, chunk: [i64; 3], dst: &mut Voxels) -> Result<ChunkRead> {
        let index = self.index(component, chunk)?;
        let Some((path, mut bytes)) = self.encoded(&index)? else {
            return Ok(ChunkRead::Missing(self.fill));
        };
        let stored_bytes = bytes.len() as u64;
        let corrupt = |e: String| Error::file(&path, format!("chunk {index:?} cannot be decoded: {e}"));
        let size = self.meta.dtype.size() as u64;
        let want = self.meta.inner.iter().product::<u64>() * size;
        if self.plain_blosc && dst.dtype() == self.meta.dtype {
            let done = guarded(|| blosc::decompress(&mut bytes, size as usize, dst.as_bytes_mut())).map_err(corrupt)?;
            if done {
                return Ok(ChunkRead::Data { stored_bytes });
            }
        }
        let mut codecs = &self.meta.codecs[..];
        for packing in &self.meta.packings {
            let unpacked = chunk_codecs::unpacked_bytes(codecs, want, self.most_encoded());
            bytes = packing.unpack(&bytes, *unpacked.end()).map_err(corrupt)?;
            codecs = &codecs[..codecs.len() - 1];
        }
        let unpacked = chunk_codecs::unpacked_bytes(codecs, want, self.most_encoded());
        chunk_codecs::check_declared(&bytes, &unpacked, codecs).map_err(corrupt)?;
        let decoded = guarded(|| {
            let (kind, fill) = (self.array.data_type(), self.array.fill_value());
            self.codecs.decode(Cow::Owned(bytes), &self.stored, kind, fill, &self.options).map_err(|e| e.to_string())
        })
        .map_err(corrupt)?;
        let ArrayBytes::Fixed(decoded) = decoded else { return Err(corrupt("not of one size per voxel".into())) };
        if decoded.len() as u64 != want {
            return Err(corrupt(format!("it expands to {} bytes, the metadata say {want}", decoded.len())));
        }
        // The selected time and channel inside the chunk.
        let lead = &self.meta.inner[..self.lead];
        let within = self.components[component].iter().zip(lead).map(|(i, c)| (i % c, c));
        let one = want / lead.iter().product::<u64>();
        if dst.as_bytes().len() as u64 != one || dst.dtype() != self.meta.dtype {
            let (have, chunk) = (dst.len(), one / size);
            return Err(Error::Failed(format!("a buffer of {have} voxels cannot hold a chunk of {chunk}")));
        }
        let into = dst.as_bytes_mut();
        match &self.strides {
            None => {
                let part = within.fold(0, |at, (i, c)| at * c + i);
                into.copy_from_slice(&decoded[(part * one) as usize..][..one as usize]);
            }
            Some(strides) => {
                let start = within.zip(strides).map(|((i, _), s)| i as usize * s).sum();
                let mut along = [0; 3];
                along[3 - (strides.len() - self.lead)..].copy_from_slice(&strides[self.lead..]);
                transposed::copy_bytes(&decoded, size as usize, start, along, into, self.chunk());
            }
        }
        Ok(ChunkRead::Data { stored_bytes })
    }

    /// The stored bytes of an inner chunk and the file they are in; `None` where it is not stored.
    fn encoded(&self, index: &[u64]) -> Result<Option<(PathBuf, Vec<u8>)>> {
        let Some(shard_meta) = &self.meta.shard else {
            let path = self.file_of(index);
            let most = self.most_encoded();
            let Some((file, len)) = open_if_there(&path)? else { return self.still_there(&path).map(|()| None) };
            if len > most {
                return Err(Error::file(&path, format!("a chunk of {len} bytes; decoded it has only {}", most / 2)));
            }
            let mut bytes = vec![0; len as usize];
            file.read_exact_at(&mut bytes, 0).map_err(|e| Error::file(&path, e))?;
            return Ok(Some((path, bytes)));
        };
        let Some((shard, entry)) = self.shard_of(index, shard_meta)? else { return Ok(None) };
        let bytes = shard.read(entry, index, self.most_encoded())?;
        Ok(bytes.map(|b| (shard.path().to_path_buf(), b)))
    }

    /// A file that is not there is a chunk that was never stored, unless its folder is gone or has changed since the array
    /// was opened: then it may have vanished, and the fill value would be a guess.
    fn still_there(&self, path: &Path) -> Result<()> {
        let inside = path.ancestors().skip(1).take_while(|d| d.starts_with(&self.folder));
        let folder = inside.filter_map(|d| d.metadata().ok()).next();
        let text = match folder.map(|m| m.modified()) {
            None => "the chunk is gone: the array's folder vanished while it was read",
            Some(Ok(changed)) if changed > self.opened => {
                "the chunk is not there, and its folder changed while the array was read: it may have been deleted"
            }
            Some(_) => return Ok(()),
        };
        Err(Error::file(path, text))
    }

    /// The shard of an inner chunk, where there is one, and the chunk's place in its index.
    fn shard_of(&self, index: &[u64], meta: &ShardMeta) -> Result<Option<(Arc<Shard>, usize)>> {
        let outer: Vec<u64> = index.iter().zip(&meta.grid).map(|(i, g)| i / g).collect();
        let shard = self.shards.get(&outer, || {
            let path = self.file_of(&outer);
            match open_if_there(&path)? {
                None => self.still_there(&path).map(|()| None),
                Some((file, len)) => Shard::open(path, file, len, meta).map(Some),
            }
        })?;
        let entry = index.iter().zip(&meta.grid).fold(0, |at, (i, g)| at * g + i % g);
        Ok(shard.map(|s| (s, entry as usize)))
    }

    /// What a chunk holds where nothing is stored for it; by its file or its shard's index, without reading a voxel.
    pub fn absent_chunk(&self, component: usize, chunk: [i64; 3]) -> Result<Option<f64>> {
        let index = self.index(component, chunk)?;
        let stored = match &self.meta.shard {
            None => self.file_of(&index).exists(),
            Some(meta) => self.shard_of(&index, meta)?.is_some_and(|(shard, entry)| shard.holds(entry)),
        };
        Ok((!stored).then_some(self.fill))
    }

    /// Longest stored form of an inner chunk that is believed.
    fn most_encoded(&self) -> u64 {
        2 * (self.meta.inner.iter().product::<u64>() * self.meta.dtype.size() as u64 + (1 << 16))
    }

    /// Fills a box by decoding the chunks that it touches, one after the other.
    pub fn read(
        &self,
        component: usize,
        region: Region,
        info: &VolumeInfo,
        mut dst: crate::grid::AnyViewMut,
    ) -> Result<u64> {
        let chunk_shape = self.chunk();
        let mut chunk = Voxels::zeroed(info.dtype, chunk_shape.iter().product());
        let mut read = 0;
        for index in region.cells([0; 3], chunk_shape).iter() {
            match self.read_chunk(component, index, &mut chunk)? {
                ChunkRead::Missing(fill) => chunk.fill(fill),
                ChunkRead::Data { stored_bytes } => read += stored_bytes,
            }
            let cell = Region::of_cell(index, [0; 3], chunk_shape);
            crate::brick::gather::copy_common(chunk.view(chunk_shape), cell, dst.reborrow(), region);
        }
        Ok(read)
    }
}

/// Opens a chunk's file; `None` where there is none.
fn open_if_there(path: &Path) -> Result<Option<(File, u64)>> {
    match File::open(path) {
        Ok(file) => {
            let meta = file.metadata().map_err(|e| Error::file(path, e))?;
            if meta.is_dir() {
                return Err(Error::file(path, "is a folder, where a chunk is expected"));
            }
            Ok(Some((file, meta.len())))
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(Error::file(path, e)),
    }
}
