//! What the text headers (NRRD, MetaImage) share: axes beyond space, interleaved components, voxels in several files.

use std::io::{BufRead, BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::bytes;
use super::lattice::{Lattice, Planes};
use super::planar::components;
use crate::config::Input;
use crate::grid::{DType, Shape};
use crate::{Error, Result};

/// What one axis of a file is, with its size. Axes are listed fastest first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Axis {
    Space(u64),
    Extra(Extra, u64),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extra {
    Time,
    Channel,
}

impl Axis {
    pub fn size(self) -> u64 {
        match self {
            Axis::Space(n) | Axis::Extra(_, n) => n,
        }
    }
}

/// Byte distances that follow from the axes.
pub struct Layout {
    pub zyx: [u64; 3],
    /// Bytes from one voxel to the next, along z, y, x.
    strides: [u64; 3],
    /// First byte of each selected component.
    pub bases: Vec<u64>,
    pub names: Vec<String>,
    /// Points in time, selected or not.
    pub times: u64,
    /// Bytes of all voxels of all components.
    pub bytes: u64,
}

/// Sorts the axes out. At most one time and one channel axis may be longer than 1.
pub fn layout(input: &Input, path: &Path, axes: &[Axis], dtype: DType) -> Result<Layout> {
    let size = dtype.size() as u64;
    let mut stride = size;
    let (mut zyx, mut strides) = ([1; 3], [0; 3]);
    let mut extra = [(1u64, 0u64); 2]; // time, channel: size and stride
    let mut space = 0;
    for axis in axes {
        match *axis {
            Axis::Space(n) => {
                (zyx[2 - space], strides[2 - space]) = (n, stride);
                space += 1;
            }
            Axis::Extra(_, 1) => {}
            Axis::Extra(kind, n) => {
                let slot = &mut extra[(kind == Extra::Channel) as usize];
                if slot.0 != 1 {
                    let sizes: Vec<_> = axes.iter().map(|a| a.size()).collect();
                    let text = format!("axes {sizes:?} are more than space, one time and one channel axis; save fewer");
                    return Err(Error::file(path, text));
                }
                *slot = (n, stride);
            }
        }
        let too_large = || Error::file(path, "the sizes in the header are larger than any file");
        stride = stride.checked_mul(axis.size()).filter(|n| *n < 1 << 62).ok_or_else(too_large)?;
    }
    if stride == 0 || space == 0 {
        return Err(Error::file(path, "the header has an axis of size 0 or no space axis"));
    }
    (space..3).for_each(|i| strides[2 - i] = stride);
    let (pairs, names) = components(input, extra[0].0 as usize, extra[1].0 as usize, &[])?;
    let bases = pairs.iter().map(|(t, c)| *t as u64 * extra[0].1 + *c as u64 * extra[1].1).collect();
    Ok(Layout { zyx, strides, bases, names, times: extra[0].0, bytes: stride })
}

impl Layout {
    /// The lattice in one file from byte `base` on. `None` where sizes overflow.
    pub fn lattice(&self, shape: Shape, dtype: DType, big_endian: bool, base: u64) -> Option<Lattice> {
        let [plane, row, step] = self.strides;
        let bases = self.bases.iter().map(|b| b.checked_add(base)).collect::<Option<_>>()?;
        let lattice = Lattice { shape, dtype, big_endian, planes: Planes::Even { bases, plane }, row, step };
        lattice.ends(1).map(|_| lattice)
    }
}

/// Spreads a lattice over `count` files of equal length, each spanning the `spanned` fastest axes (by default, as many
/// as leave one file per entry of the remaining ones), its voxels starting at byte `base`.
pub fn over_files(
    path: &Path,
    lattice: Lattice,
    axes: &[Axis],
    count: usize,
    spanned: Option<usize>,
    base: u64,
) -> Result<Lattice> {
    let total: u64 = axes.iter().map(|a| a.size()).product::<u64>() * lattice.dtype.size() as u64;
    let mismatch = |text: String| Err(Error::file(path, format!("{count} data files do not fit the sizes: {text}")));
    if count == 0 || !total.is_multiple_of(count as u64) {
        return mismatch(format!("{total} bytes of voxels"));
    }
    let each = total / count as u64;
    if let Some(n) = spanned {
        let want: u64 = axes.iter().skip(n).map(|a| a.size()).product();
        if n == 0 || want != count as u64 {
            return mismatch(format!("{want} files of {n} axes are expected"));
        }
    }
    let span = lattice.plane_span().unwrap_or(u64::MAX);
    let bases = match &lattice.planes {
        Planes::Even { bases, .. } => bases.len(),
        Planes::Table(_) => 0,
    };
    let entries = bases.saturating_mul(lattice.shape[0]);
    if entries > 1 << 24 {
        return mismatch(format!("{entries} planes are too many"));
    }
    let mut table = Vec::with_capacity(entries);
    for component in 0..bases {
        for z in 0..lattice.shape[0] {
            let at = lattice.plane_at(component, z).1;
            let (file, inside) = (at / each, at % each);
            if inside + span > each {
                return mismatch("a plane would be split between files".to_string());
            }
            table.push((file as u32, inside.saturating_add(base)));
        }
    }
    Ok(Lattice { planes: Planes::Table(table), ..lattice })
}

/// File names of a printf pattern (`slice%03d.raw`) from `from` to `to`, both included.
pub fn pattern(path: &Path, folder: &Path, pattern: &str, from: i64, to: i64, by: i64) -> Result<Vec<PathBuf>> {
    let broken = |text: &str| Error::file(path, format!("broken file pattern `{pattern} {from} {to} {by}`: {text}"));
    let (before, rest) = pattern.split_once('%').ok_or_else(|| broken("no %d"))?;
    let (width, after) = rest.split_once('d').ok_or_else(|| broken("only %d with a width is read"))?;
    let zeros = width.starts_with('0');
    let digits = if width.is_empty() { Ok(0) } else { width.parse::<usize>() };
    let digits = digits.ok().filter(|n| *n <= 32).ok_or_else(|| broken("only %d with a width is read"))?;
    let count = if by == 0 { None } else { (to.checked_sub(from)).and_then(|d| d.checked_div(by)) };
    let count =
        count.filter(|n| (0..1_000_000).contains(n)).ok_or_else(|| broken("min, max and step name no files"))?;
    let name = |i: i64| {
        let n = from + i * by;
        let number = if zeros { format!("{n:0digits$}") } else { format!("{n:digits$}") };
        folder.join(format!("{before}{number}{after}"))
    };
    Ok((0..=count).map(name).collect())
}

/// Byte after `lines` lines of a file, counted from byte `start`.
pub fn skip_lines(path: &Path, start: u64, lines: u64) -> Result<u64> {
    if lines == 0 {
        return Ok(start);
    }
    let failed = |e: std::io::Error| Error::file(path, e);
    let mut file = bytes::open_file(path)?;
    file.seek(SeekFrom::Start(start)).map_err(failed)?;
    let mut reader = BufReader::new(file);
    let (mut at, mut left) = (start, lines);
    while left > 0 {
        let block = reader.fill_buf().map_err(failed)?;
        if block.is_empty() {
            return Err(Error::file(
                path,
                format!("the header skips {lines} lines, but the file has only {}", lines - left),
            ));
        }
        let used = block.iter().position(|b| *b == b'\n').map(|i| i + 1);
        left -= used.is_some() as u64;
        let used = used.unwrap_or(block.len());
        reader.consume(used);
        at += used as u64;
    }
    Ok(at)
}
