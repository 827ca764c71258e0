//! Volumes that are read by plain rows: mapped files, unpacked or re-blocked first where they are packed.

use std::ops::Range;
use std::path::{Path, PathBuf};

use super::bytes::{self, Files, MappedFile};
use super::identity;
use super::lattice::{Lattice, Planes};
use super::reblock::Reblock;
use super::spool::{After, Packed, Progress};
use crate::config::{Input, Select};
use crate::grid::{AnyViewMut, Region};
use crate::kernel::simd::Level;
use crate::store::VolumeInfo;
use crate::{Error, Result};

/// Above this many files, each is mapped only while it is read.
const MOST_HELD: usize = 16;

/// What a header parser finds out.
#[derive(Debug)]
pub struct Parsed {
    pub info: VolumeInfo,
    /// Where the voxels lie in `files`, or in the scratch file once `pending` is done.
    pub lattice: Lattice,
    /// Files that hold voxels; the first one is hashed for the identity.
    pub files: Vec<PathBuf>,
    pub pending: Pending,
    /// The header as stored, for the identity.
    pub header: Vec<u8>,
    /// Bytes after the last voxel of a single file are an error.
    pub exact: bool,
}

/// What [`Planar::prepare`] has to do first.
#[derive(Debug)]
pub enum Pending {
    Nothing,
    Unpack(Packed),
    Reblock(Reblock),
}

/// An open volume of plain rows.
#[derive(Debug)]
pub struct Planar {
    lattice: Lattice,
    /// `None` until prepared.
    files: Option<Files>,
    pending: Pending,
    pub paths: Vec<PathBuf>,
    pub header: Vec<u8>,
}

impl Planar {
    /// Checks the sizes against the files and maps what can be read in place.
    pub fn new(parsed: Parsed) -> Result<(VolumeInfo, Planar)> {
        let Parsed { info, lattice, files: paths, pending, header, exact } = parsed;
        let files = match &pending {
            Pending::Nothing => Some(open_all(&info, &lattice, &paths, exact)?),
            _ => None,
        };
        Ok((info, Planar { lattice, files, pending, paths, header }))
    }

    /// A volume in memory.
    pub fn memory(lattice: Lattice, voxels: crate::brick::Voxels) -> Planar {
        let files = Some(Files::Memory(voxels));
        Planar { lattice, files, pending: Pending::Nothing, paths: Vec::new(), header: Vec::new() }
    }

    /// A volume in files that are open already.
    pub fn held(lattice: Lattice, files: Files) -> Planar {
        Planar { lattice, files: Some(files), pending: Pending::Nothing, paths: Vec::new(), header: Vec::new() }
    }

    pub fn spool_bytes(&self) -> u64 {
        match &self.pending {
            Pending::Nothing => 0,
            Pending::Unpack(packed) => packed.len,
            Pending::Reblock(reblock) => reblock.bytes(),
        }
    }

    /// See [`super::Source::narrow`].
    pub fn narrow(&mut self, planes: Range<usize>) {
        match &mut self.pending {
            Pending::Nothing => {}
            Pending::Unpack(packed) => {
                // A stream is unpacked from its start, but not to its end.
                let len = self.lattice.end_of(&planes).unwrap_or(packed.len);
                if len < packed.len {
                    (packed.len, packed.after) = (len, After::Ignored);
                }
            }
            Pending::Reblock(reblock) => {
                let depth = self.lattice.shape[0];
                reblock.wanted.retain(|plane| planes.contains(&(plane % depth)));
            }
        }
    }

    pub fn prepare(&mut self, scratch: &Path, progress: Progress) -> Result<()> {
        let file = match &self.pending {
            Pending::Nothing => return Ok(()),
            Pending::Unpack(packed) => packed.unpack(scratch, progress)?,
            Pending::Reblock(reblock) => reblock.run(&self.paths, scratch, progress)?,
        };
        let need = self.lattice.ends(1).map_or(u64::MAX, |e| e[0]);
        // Planes that nobody reads are holes.
        let holes = file.metadata().and_then(|m| if m.len() < need { file.set_len(need) } else { Ok(()) });
        holes.map_err(|e| Error::file(scratch, format!("scratch: {e}")))?;
        let mapped = MappedFile::of(scratch, file)?;
        if mapped.len() < need {
            let text = format!("the scratch file has {} bytes, {need} are needed", mapped.len());
            return Err(Error::file(scratch, text));
        }
        self.files = Some(Files::Held(vec![mapped]));
        self.pending = Pending::Nothing;
        Ok(())
    }

    /// See [`super::Source::read`] and [`super::Source::read_again`].
    pub fn read(&self, level: Level, component: usize, region: Region, dst: AnyViewMut, keep: bool) -> Result<u64> {
        let files = self
            .files
            .as_ref()
            .ok_or_else(|| Error::Failed("a packed input was read before it was unpacked".into()))?;
        self.lattice.read(level, files, component, region, dst, keep)
    }

    /// See [`super::Source::identity`].
    pub fn identity(&self, format: &str) -> Result<serde_json::Value> {
        match &self.files {
            Some(Files::Memory(voxels)) => Ok(identity::of_memory(voxels.as_bytes())),
            _ => identity::of_files(format, &self.header, &self.paths),
        }
    }

    /// Drops the pages of the planes of `region` if it holds whole planes.
    pub fn release(&self, region: Region) {
        let whole = Region::whole(self.lattice.shape);
        let planes = region.clip(&whole);
        let (Some(Files::Held(files)), Some(span)) = (&self.files, self.lattice.plane_span()) else { return };
        if planes.is_empty() || planes.lo[1..] != whole.lo[1..] || planes.hi[1..] != whole.hi[1..] {
            return;
        }
        match &self.lattice.planes {
            Planes::Even { bases, plane } => {
                for base in bases {
                    let end = base + (planes.hi[0] - 1) as u64 * plane + span;
                    files[0].forget(base + planes.lo[0] as u64 * plane, end);
                }
            }
            Planes::Table(table) => {
                for component in table.chunks(self.lattice.shape[0]) {
                    for (file, start) in &component[planes.lo[0] as usize..planes.hi[0] as usize] {
                        files[*file as usize].forget(*start, start + span);
                    }
                }
            }
        }
    }
}

fn open_all(info: &VolumeInfo, lattice: &Lattice, paths: &[PathBuf], exact: bool) -> Result<Files> {
    let first = paths.first().map_or(Path::new(""), |p| p);
    let ends = lattice.ends(paths.len()).ok_or_else(|| Error::file(first, "the sizes in the header overflow"))?;
    let check = |index: usize, path: &Path, len: u64| -> Result<()> {
        let need = ends[index];
        let what = || format!("shape {:?} of {} ends at byte {need}", info.shape, info.dtype);
        if len < need {
            return Err(Error::file(
                path,
                format!(
                    "has {len} bytes, but {}: the file is cut off or its header is wrong (raw: shape, dtype, offset)",
                    what()
                ),
            ));
        }
        if exact && len > need {
            let extra = len - need;
            return Err(Error::file(
                path,
                format!(
                    "has {len} bytes, but {}: {extra} more follow; check shape, dtype and offset, or allow them with trailing = \"ignore\"",
                    what()
                ),
            ));
        }
        Ok(())
    };
    if paths.len() > MOST_HELD {
        let lens = paths.iter().enumerate().map(|(i, path)| {
            let len = bytes::file_len(path)?;
            check(i, path, len)?;
            Ok((path.clone(), len))
        });
        return Ok(Files::OnDemand(lens.collect::<Result<_>>()?));
    }
    let mut held = Vec::new();
    for (i, path) in paths.iter().enumerate() {
        check(i, path, bytes::file_len(path)?)?; // before mapping: an empty file cannot be mapped
        let mapped = MappedFile::open(path)?;
        check(i, path, mapped.len())?;
        held.push(mapped);
    }
    Ok(Files::Held(held))
}

/// Dotted key of one entry of an input's table.
pub fn key(input: &Input, entry: &str) -> String {
    match input.place.key.as_str() {
        "" => format!("input.{}.{entry}", input.name),
        table => format!("{table}.{entry}"),
    }
}

/// Indices that a selection names among `count` (of what: `channel`, `time`).
fn pick(input: &Input, select: Select, count: usize, what: &str) -> Result<Vec<usize>> {
    match select {
        Select::All => Ok((0..count).collect()),
        Select::Index(i) if i < count => Ok(vec![i]),
        Select::Index(i) => {
            let have = match count {
                1 => format!("the input has 1 {what}: 0"),
                n => format!("the input has {n} ({what} 0 to {}), or \"all\"", n - 1),
            };
            Err(Error::config(key(input, what), format!("{i} does not exist; {have}")))
        }
    }
}

/// More components than this are a mistake in the header.
const MOST_COMPONENTS: usize = 65536;

/// Time and channel of one component.
pub type TimeChannel = (usize, usize);

/// The (time, channel) pairs that the input selects, time slowest, and their names (none for a scalar volume).
pub fn components(
    input: &Input,
    times: usize,
    channels: usize,
    labels: &[String],
) -> Result<(Vec<TimeChannel>, Vec<String>)> {
    let (t, c) = (pick(input, input.time, times, "time")?, pick(input, input.channel, channels, "channel")?);
    if t.len().saturating_mul(c.len()) > MOST_COMPONENTS {
        let text =
            format!("\"all\" would give {} x {} components; at most {MOST_COMPONENTS} are read", t.len(), c.len());
        return Err(Error::config(key(input, "channel"), text));
    }
    let pairs: Vec<_> = t.iter().flat_map(|t| c.iter().map(move |c| (*t, *c))).collect();
    if input.time != Select::All && input.channel != Select::All {
        return Ok((pairs, Vec::new()));
    }
    let label = |c: usize| labels.get(c).filter(|l| !l.is_empty()).cloned().unwrap_or_else(|| format!("channel {c}"));
    let name = |(t, c): &(usize, usize)| match (input.time, input.channel) {
        (Select::All, Select::All) if channels > 1 && times > 1 => format!("time {t}, {}", label(*c)),
        (Select::All, _) if times > 1 || input.channel != Select::All => format!("time {t}"),
        _ => label(*c),
    };
    let names = pairs.iter().map(name).collect();
    Ok((pairs, names))
}

/// `[z, y, x]` as `usize`, after checks that no axis is 0 and that the bytes of one component can be counted.
pub fn shape_of(path: &Path, zyx: [u64; 3], size: usize) -> Result<[usize; 3]> {
    if let Some(axis) = zyx.iter().position(|n| *n == 0) {
        return Err(Error::file(path, format!("axis {} has size 0 (shape {zyx:?})", ["z", "y", "x"][axis])));
    }
    let bytes = zyx.iter().try_fold(size as u64, |n, d| n.checked_mul(*d)).filter(|n| *n <= i64::MAX as u64 / 4);
    if bytes.is_none() || zyx.iter().any(|n| *n > 1 << 40) {
        return Err(Error::file(path, format!("shape {zyx:?} is larger than any file; the header is wrong")));
    }
    Ok(zyx.map(|n| n as usize))
}
