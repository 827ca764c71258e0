//! Where each voxel lies in plain bytes, and the copy from there into a brick.

use std::ops::Range;

use super::bytes::Files;
use crate::grid::{AnyViewMut, DType, Region, Shape, ViewMut, Voxel};
use crate::kernel::simd::Level;
use crate::{Result, multiversion, with_view};

/// Voxels in uncompressed bytes: plane by plane, rows and voxels at even distances.
#[derive(Debug, Clone, PartialEq)]
pub struct Lattice {
    pub shape: Shape,
    pub dtype: DType,
    pub big_endian: bool,
    pub planes: Planes,
    /// Bytes from one row to the next.
    pub row: u64,
    /// Bytes from one voxel of a row to the next.
    pub step: u64,
}

/// Where the planes of the components start.
#[derive(Debug, Clone, PartialEq)]
pub enum Planes {
    /// All in file 0: the first byte of each component, and the bytes from one plane to the next.
    Even { bases: Vec<u64>, plane: u64 },
    /// File and first byte of plane `component * nz + z`.
    Table(Vec<(u32, u64)>),
}

/// Bytes of a mapped file that a reader may leave resident: a file that was just written can lie in the page cache in pieces
/// of megabytes, and a touch then maps the whole piece, so a box of many planes maps most of the file.
const MAPPED: u64 = 16 << 20;

/// Bytes of a plane of a box that are read by a call instead of through the map, whose pages the system has to find and to let go
/// again. 2-core Zen 4 VM, 2026-11-27, raw u16 to raw u8 of 512 x 256 x 256, six runs by turns, least and median: 111 and 117 ms by
/// calls, 122 and 129 through the map.
const RUN: usize = 32 << 10;

impl Lattice {
    /// One component, densely packed from byte `base` of one file on. `None` where the sizes overflow.
    pub fn dense(shape: Shape, dtype: DType, big_endian: bool, base: u64) -> Option<Lattice> {
        let size = dtype.size() as u64;
        let row = size.checked_mul(shape[2] as u64)?;
        let plane = row.checked_mul(shape[1] as u64)?;
        plane.checked_mul(shape[0] as u64)?.checked_add(base)?;
        let planes = Planes::Even { bases: vec![base], plane };
        Some(Lattice { shape, dtype, big_endian, planes, row, step: size })
    }

    /// File and first byte of a plane.
    pub fn plane_at(&self, component: usize, z: usize) -> (usize, u64) {
        match &self.planes {
            Planes::Even { bases, plane } => (0, bases[component] + z as u64 * plane),
            Planes::Table(table) => {
                let (file, start) = table[component * self.shape[0] + z];
                (file as usize, start)
            }
        }
    }

    /// Bytes from the first to past the last voxel of a plane. `None` where that overflows.
    pub fn plane_span(&self) -> Option<u64> {
        let [_, y, x] = self.shape.map(|n| n as u64);
        let rows = self.row.checked_mul(y.checked_sub(1)?)?;
        rows.checked_add(self.step.checked_mul(x.checked_sub(1)?)?)?.checked_add(self.dtype.size() as u64)
    }

    /// Bytes that each of `files` files must have; 0 for one without voxels. `None` where that overflows.
    pub fn ends(&self, files: usize) -> Option<Vec<u64>> {
        let span = self.plane_span()?;
        let mut ends = vec![0; files];
        let mut claim = |file: usize, start: u64| -> Option<()> {
            let end = ends.get_mut(file)?;
            *end = start.checked_add(span)?.max(*end);
            Some(())
        };
        match &self.planes {
            Planes::Even { bases, plane } => {
                let last = plane.checked_mul(self.shape[0].checked_sub(1)? as u64)?;
                claim(0, bases.iter().max()?.checked_add(last)?)?;
            }
            Planes::Table(table) => table.iter().try_for_each(|(file, start)| claim(*file as usize, *start))?,
        }
        Some(ends)
    }

    /// Byte after the last one of these planes, of any component, where they lie evenly in one file.
    pub fn end_of(&self, planes: &Range<usize>) -> Option<u64> {
        let Planes::Even { bases, plane } = &self.planes else { return None };
        let Some(last) = planes.clone().next_back() else { return Some(0) };
        Some(bases.iter().max()? + last as u64 * plane + self.plane_span()?)
    }

    /// Copies the box into `dst`, which has its shape and the lattice's type. Returns the bytes taken. Pages of mapped files
    /// are let go behind it unless they are to be kept.
    #[allow(clippy::too_many_arguments)]
    pub fn read(
        &self,
        level: Level,
        files: &Files,
        component: usize,
        region: Region,
        mut dst: AnyViewMut,
        keep: bool,
    ) -> Result<u64> {
        if region.is_empty() {
            return Ok(0);
        }
        let size = self.dtype.size() as u64;
        let offset = region.lo[1] as u64 * self.row + region.lo[2] as u64 * self.step;
        let swap = self.big_endian != cfg!(target_endian = "big");
        let span = self.plane_span().unwrap_or(0);
        // The file and its bytes that the planes since the last release lie in.
        let mut front: Option<(usize, u64, u64)> = None;
        for z in region.lo[0]..region.hi[0] {
            let (file, start) = self.plane_at(component, z as usize);
            let into = (z - region.lo[0]) as usize;
            let run = with_view!(AnyViewMut, &mut dst, v => self.run(v, into));
            if let (Some(held), Some(run)) = (files.held(file), run) {
                held.read_at(start + offset, run)?;
                if swap {
                    reverse(level, run, size as usize);
                }
                continue;
            }
            front = match front {
                Some((f, lo, hi)) if keep || f == file && hi.max(start + span) - lo.min(start) <= MAPPED => {
                    Some((f, lo.min(start), hi.max(start + span)))
                }
                behind => {
                    behind.into_iter().for_each(|(f, lo, hi)| files.forget(f, lo, hi));
                    Some((file, start, start + span))
                }
            };
            let from = (start + offset) as usize;
            files.with_bytes(file, |bytes| {
                let bytes = &bytes[from..];
                with_view!(AnyViewMut, &mut dst, v => self.plane(level, bytes, swap, v, into));
                Ok(())
            })?;
        }
        front.into_iter().filter(|_| !keep).for_each(|(f, lo, hi)| files.forget(f, lo, hi));
        Ok(region.voxels() as u64 * size)
    }

    /// Plane `z` of a box in one piece, where it lies in the file in one, too, and is long enough for a call.
    fn run<'d, T: Voxel>(&self, dst: &'d mut ViewMut<T>, z: usize) -> Option<&'d mut [u8]> {
        let [_, ny, nx] = dst.shape;
        let dense = dst.row == nx && self.step as usize == size_of::<T>() && self.row == self.step * nx as u64;
        let fits = dense && ny * nx * size_of::<T>() >= RUN;
        let from = z * dst.plane;
        fits.then(|| bytemuck::cast_slice_mut(&mut dst.data[from..from + ny * nx]))
    }

    /// One plane of a box: `bytes` starts at the box's first voxel of it.
    fn plane<T: Voxel>(&self, level: Level, bytes: &[u8], swap: bool, dst: &mut ViewMut<T>, z: usize) {
        let [_, ny, nx] = dst.shape;
        let (row, step, size) = (self.row as usize, self.step as usize, size_of::<T>());
        for y in 0..ny {
            let from = &bytes[y * row..];
            let into = bytemuck::cast_slice_mut(dst.row_at(z, y));
            if step == size {
                into.copy_from_slice(&from[..nx * size]);
            } else {
                for (x, d) in into.chunks_exact_mut(size).enumerate() {
                    d.copy_from_slice(&from[x * step..x * step + size]);
                }
            }
            if swap {
                reverse(level, into, size);
            }
        }
    }
}

multiversion! {
    /// Reverses the bytes of each element of `size` bytes, in place.
    pub fn reverse[](bytes: &mut [u8], size: usize) -> () = reverse_any;
}

#[inline(always)]
fn reverse_any(bytes: &mut [u8], size: usize) {
    match size {
        2 => reverse_of::<2>(bytes),
        4 => reverse_of::<4>(bytes),
        8 => reverse_of::<8>(bytes),
        _ => {}
    }
}

#[inline(always)]
fn reverse_of<const N: usize>(bytes: &mut [u8]) {
    for element in bytes.as_chunks_mut::<N>().0 {
        element.reverse();
    }
}

/// Turns the stored `nodata` value of float voxels into NaN; integers are left alone.
pub fn mark_missing(dst: &mut AnyViewMut, nodata: f64) {
    fn rows<T: Voxel>(v: &mut ViewMut<T>, missing: T, nan: T) {
        let [nz, ny, _] = v.shape;
        for z in 0..nz {
            for y in 0..ny {
                for value in v.row_at(z, y) {
                    *value = if *value == missing { nan } else { *value };
                }
            }
        }
    }
    match dst {
        AnyViewMut::F32(v) => rows(v, nodata as f32, f32::NAN),
        AnyViewMut::F64(v) => rows(v, nodata, f64::NAN),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brick::Voxels;

    #[test]
    fn reversing_agrees_with_the_standard_library_at_every_level() {
        for level in Level::available() {
            for n in [0usize, 1, 7, 63, 64, 65, 257] {
                let source: Vec<u8> = (0..n * 8).map(|i| (i * 37 + 11) as u8).collect();
                for size in [1, 2, 4, 8] {
                    let mut fast = source.clone();
                    reverse(level, &mut fast, size);
                    let slow: Vec<u8> = source.chunks(size).flat_map(|c| c.iter().rev().copied()).collect();
                    assert_eq!(fast, slow, "{level:?} {n} x {size}");
                }
            }
        }
    }

    /// Every voxel of a strided, big-endian lattice lands where its formula says.
    #[test]
    fn boxes_of_a_strided_lattice_hold_the_right_voxels() {
        let shape = [3, 4, 5];
        let (base, step, row, plane) = (7u64, 6u64, 33u64, 150u64);
        let mut bytes = vec![0xEEu8; 1000];
        for [z, y, x] in Region::whole(shape).iter() {
            let at = (base + z as u64 * plane + y as u64 * row + x as u64 * step) as usize;
            bytes[at..at + 2].copy_from_slice(&((z * 100 + y * 10 + x) as u16).to_be_bytes());
        }
        let planes = Planes::Even { bases: vec![base], plane };
        let lattice = Lattice { shape, dtype: DType::U16, big_endian: true, planes, row, step };
        let files = Files::Memory(Voxels::U8(bytes));
        for level in Level::available() {
            let region = Region::new([1, 0, 2], [3, 4, 5]);
            let mut out = Voxels::zeroed(DType::U16, region.voxels());
            let taken = lattice.read(level, &files, 0, region, out.view_mut(region.shape()), false).unwrap();
            assert_eq!(taken, region.voxels() as u64 * 2);
            for (i, [z, y, x]) in region.iter().enumerate() {
                assert_eq!(out.at(i), (z * 100 + y * 10 + x) as f64);
            }
        }
    }
}
