//! Obscurance sweeps along parallel lattice lines (paper B; SPEC section 4).
//!
//! | file | holds |
//! |---|---|
//! | `lines` | directions to families of lines, distances, fixed-point contributions |
//! | `keys` | voxels to padded, order-preserving unsigned keys |
//! | `driver` | tiles, sheets, senses |
//! | `column`, `stream` | sweeps of boxes whose halos do not fit into memory |
//! | `scan` | next greater key on 64 lines; `narrow`: by AVX2 or SSE2, `wide` and `turn`: by AVX-512 |
//! | `sinks`, `contribute`, `weighted` | what is summed |
//! | `wanted` | which lines are searched |
//! | `room` | how scratch is cut up |
//! | `shared` | what another device needs |
//! | `reference` | all of it by the definition |

mod column;
mod contribute;
mod driver;
mod keys;
mod lines;
#[cfg(target_arch = "x86_64")]
mod narrow;
mod ranks;
#[cfg(test)]
mod reference;
mod room;
mod scan;
pub mod shared;
mod sinks;
mod stream;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod turn;
mod wanted;
mod weighted;
#[cfg(target_arch = "x86_64")]
mod wide;

use super::Context;
use crate::grid::{AnyView, AnyViewMut, DType, Region, Shape, View, ViewMut};
use crate::kernel::simd::Level;
use crate::stage::{DirectionSet, DirectionWeights, Rho};
use crate::with_view;
use driver::{Buffers, FRAMES, in_frame};
use keys::{Coded, Key, Volume};
use room::{Sizes, carve};
use sinks::{OpenSum, Sink};
use wanted::Wanted;
use weighted::WeightedSum;

pub use lines::{is_valid_count, rho};
pub use stream::Fetch;
pub use wanted::LineCounts;

/// Parameters with units resolved.
#[derive(Debug, Clone, PartialEq)]
pub struct ObscuranceParams {
    pub directions: usize,
    pub set: DirectionSet,
    pub weights: DirectionWeights,
    pub rho: Rho,
    /// In voxels of the finest axis.
    pub max_distance: f64,
    /// Physical voxel size, `[z, y, x]`.
    pub spacing: [f64; 3],
    /// Smaller stored values are denser (`solid = "low"` or a negative slope, not both).
    pub flipped: bool,
    /// Stored value of integer types that marks a missing voxel; floats use NaN.
    pub missing: Option<i64>,
    /// Linear r, g, b seen where nothing occludes.
    pub ambient: [f64; 3],
}

/// Directions, lines and tables made once from the parameters.
#[derive(Debug, Clone)]
pub struct Prepared {
    params: ObscuranceParams,
    families: Vec<lines::Family>,
    /// Sum of contributions where nothing occludes.
    total: u64,
    /// Sum of weights, in units of the weighted sums.
    uniform: i64,
}

/// What a sweep reads besides densities, and writes.
pub struct ObscuranceIo<'a> {
    /// Colour of each voxel of `src` (linear r, g, b, and a number that is not looked at: an occluder's colour is one read),
    /// for colour bleeding. NaN counts as 0, and everything is cut off at +-2^18.
    pub colour: Option<View<'a, [f32; 4]>>,
    /// Components along z, y, x of the physical gradient of the *stored* values on the *output* box, for
    /// `weight_by_normal`: directions weigh max(0, n.w), n pointing toward the open side. Uniform where it is zero or not
    /// finite. Where no direction of the set has a positive weight, the voxel is open.
    pub normal: Option<[View<'a, f32>; 3]>,
    /// Voxels of the output box that are asked for: 0 is not, and its outputs are left alone or filled with anything. Lines
    /// without one that is are not searched.
    pub needed: Option<View<'a, u8>>,
    /// f32, the output box.
    pub openness: Option<AnyViewMut<'a>>,
    /// f32, the output box. Asks for `colour`.
    pub rgb: Option<[AnyViewMut<'a>; 3]>,
}

/// Output voxels whose sums are kept at once, `[z, y, x]`. Long lines waste less on halos than sums gain from a nearer
/// cache: 2-core Zen 4 VM, AVX-512, 2026-11-26, u8, 42 directions, distance 64, bricks with halos of 64: `[256, 128, 256]`
/// in one tile 0.76 ns per voxel and direction, `[128, 256, 256]` in two tiles 1.08. A sweep of one tile keeps one copy of
/// the keys, so that 256^3 takes the bytes of two tiles of half the size.
const TILE: Shape = [256; 3];
/// The same for sums of 64 bits, of which there are up to five.
const WEIGHTED_TILE: Shape = [128, 128, 256];

/// Extents of a tile of an output box.
fn tile_of(dst: Shape, weighted: bool) -> Shape {
    let most = if weighted { WEIGHTED_TILE } else { TILE };
    std::array::from_fn(|a| most[a].min(dst[a]))
}

impl Prepared {
    /// Panics on a spacing or distance that is not positive.
    pub fn new(params: &ObscuranceParams) -> Prepared {
        assert!(params.spacing.iter().all(|s| *s > 0.0 && s.is_finite()), "spacing {:?}", params.spacing);
        assert!(params.max_distance >= 0.0, "max_distance {}", params.max_distance);
        let (mut families, total) = lines::families(params);
        driver::sort(&mut families);
        let uniform = weighted::uniform(&families);
        Prepared { params: params.clone(), families, total, uniform }
    }

    /// Halo in voxels per axis.
    pub fn reach(&self) -> [usize; 3] {
        self.families.iter().map(|f| f.halo()).fold([0; 3], |m, h| std::array::from_fn(|a| m[a].max(h[a])))
    }

    /// Sweeps every direction. `src` covers `src_box`: `dst_box` grown by [`Self::reach`] and clipped to the volume, in
    /// *global* indices (lines are tiled by them). Beyond `src` everything is open. A missing voxel outputs NaN.
    ///
    /// Within 1e-6 of the formula; the bits do not depend on the boxes, nor on the level of the CPU.
    /// Panics if an extent does not fit its box, an output is not f32, or `rgb` comes without `colour`.
    pub fn sweep(
        &self,
        src: AnyView,
        src_box: Region,
        dst_box: Region,
        io: ObscuranceIo,
        cx: &mut Context,
    ) -> LineCounts {
        assert_eq!(src.shape(), src_box.shape(), "src must cover its box");
        assert!(src_box.contains(&dst_box), "{src_box:?} must contain {dst_box:?}");
        if dst_box.is_empty() {
            return LineCounts::default();
        }
        let mask = io.needed.map_or(0, |_| self.masked_bytes(dst_box.shape()));
        let (colour, normal) = (io.rgb.is_some(), io.normal.is_some());
        let most = self.scratch_bytes(src.dtype(), src_box.shape(), dst_box.shape(), colour, normal) + mask;
        let bytes = cx.scratch.take(most);
        if let (AnyView::F32(v), None) = (src, self.params.missing) {
            let (codes, rest) = carve::<u8>(&mut *bytes, src_box.voxels());
            if ranks::rank(v, codes) {
                return self.sweep_typed(View::dense(codes, v.shape), src_box, dst_box, io, cx.level, rest);
            }
        }
        with_view!(AnyView, src, v => self.sweep_typed(v, src_box, dst_box, io, cx.level, bytes))
    }

    /// Bytes of scratch that [`Self::sweep`] takes at most, apart from [`Self::masked_bytes`].
    pub fn scratch_bytes(&self, dtype: DType, src: Shape, dst: Shape, colour: bool, normal: bool) -> usize {
        let sizes = self.sizes(src, dst, colour || normal);
        let bytes = sizes.bytes(dtype.size(), colour, normal);
        match dtype {
            // Floats of few values are swept as bytes.
            DType::F32 => {
                bytes.max(src.iter().product::<usize>().next_multiple_of(64) + sizes.bytes(1, colour, normal))
            }
            _ => bytes,
        }
    }

    /// Bytes of scratch that a sweep takes besides where only some voxels are needed.
    pub fn masked_bytes(&self, dst: Shape) -> usize {
        8 * self.mask_words(dst).iter().map(|words| words.next_multiple_of(8)).sum::<usize>()
    }

    /// Words of the bits of a tile's needed voxels, in both frames.
    fn mask_words(&self, dst: Shape) -> [usize; 2] {
        let tile = tile_of(dst, false);
        let turned = self.families.iter().any(|f| f.axis == 2);
        [wanted::words_of(tile), if turned { wanted::words_of(FRAMES[1].map(|a| tile[a])) } else { 0 }]
    }

    fn sizes(&self, src: Shape, dst: Shape, weighted: bool) -> Sizes {
        let tile = tile_of(dst, weighted);
        let planes = |f: &lines::Family| (tile[f.axis] + 2 * driver::reach_in(f, src[f.axis])).min(src[f.axis]);
        let turned = self.families.iter().any(|f| f.axis == 2);
        let copies = [keys::padded_len(src), if turned { keys::padded_len(FRAMES[1].map(|a| src[a])) } else { 0 }];
        Sizes {
            keys: if tile == dst { [copies[0].max(copies[1]), 0] } else { copies },
            sums: FRAMES.map(|frame| sinks::sums_len(tile, frame)),
            sheet: self.families.iter().map(planes).max().unwrap_or(0),
            queries: tile.into_iter().max().unwrap_or(0),
            extent: src.into_iter().max().unwrap_or(0),
        }
    }

    fn sweep_typed<T: Coded>(
        &self,
        src: View<T>,
        src_box: Region,
        dst_box: Region,
        io: ObscuranceIo,
        level: Level,
        bytes: &mut [u8],
    ) -> LineCounts {
        let weighted = io.rgb.is_some() || io.normal.is_some();
        let sizes = self.sizes(src_box.shape(), dst_box.shape(), weighted);
        let words = io.needed.map_or([0; 2], |_| self.mask_words(dst_box.shape()));
        let (natural_mask, bytes) = carve::<u64>(bytes, words[0]);
        let (turned_mask, bytes) = carve::<u64>(bytes, words[1]);
        let (natural, bytes) = carve::<T::Key>(bytes, sizes.keys[0]);
        let (swapped, bytes) = carve::<T::Key>(bytes, sizes.keys[1]);
        let (buffers, bytes) = sizes.buffers::<T::Key>(bytes);

        let missing = keys::missing_of::<T>(self.params.missing);
        let code = keys::Code { missing, flipped: self.params.flipped };
        let most = keys::encode(level, src, code, natural);
        let at = src_box.offset_of(&dst_box);
        // Nothing is greater than any voxel that is asked for.
        let flat = keys::least(level, src.part(at, dst_box.shape()), code) >= most;
        let encode = |frame: usize, out: &mut [T::Key]| match frame {
            0 => _ = keys::encode(level, src, code, out),
            _ => keys::encode_turned(level, src, code, out),
        };
        let mut pass = Pass {
            prepared: self,
            level,
            flat,
            keys: Keys {
                shared: swapped.is_empty(),
                copies: [natural, swapped],
                hold: [Some(0), None],
                encode: &encode,
            },
            src_box,
            dst_box,
            buffers,
            masks: [natural_mask, turned_mask],
            counts: LineCounts::default(),
        };
        // NaN where a voxel of the row that starts at `p` is missing.
        let gone = |p: [i64; 3], row: &mut [f32]| {
            let [z, y, x] = [0, 1, 2].map(|a| (p[a] - src_box.lo[a]) as usize);
            mark_missing(&src.row_at(z, y)[x..], missing, row);
        };
        pass.tiles(io, bytes, &gone);
        pass.counts
    }
}

/// One sweep of one brick.
struct Pass<'a, K> {
    prepared: &'a Prepared,
    level: Level,
    /// Nothing is greater than anything.
    flat: bool,
    keys: Keys<'a, K>,
    src_box: Region,
    dst_box: Region,
    buffers: Buffers<'a, K>,
    /// For the needed voxels of a tile in both frames.
    masks: [&'a mut [u64]; 2],
    counts: LineCounts,
}

/// Padded copies of the source in the order of each frame. A sweep of one tile needs one after the other, in one place.
struct Keys<'a, K> {
    copies: [&'a mut [K]; 2],
    shared: bool,
    /// The frame that each copy is in.
    hold: [Option<usize>; 2],
    encode: &'a dyn Fn(usize, &mut [K]),
}

impl<K> Keys<'_, K> {
    fn in_frame(&mut self, frame: usize) -> &[K] {
        let place = if self.shared { 0 } else { frame };
        if self.hold[place] != Some(frame) {
            (self.encode)(frame, self.copies[place]);
            self.hold[place] = Some(frame);
        }
        self.copies[place]
    }
}

impl<K: Key> Pass<'_, K> {
    fn tiles(&mut self, io: ObscuranceIo, bytes: &mut [u8], gone: &dyn Fn([i64; 3], &mut [f32])) {
        let ObscuranceIo { colour, normal, needed, openness, rgb } = io;
        let mut openness = openness.map(f32_view);
        let mut rgb = rgb.map(|views| views.map(f32_view));
        assert!(rgb.is_none() || colour.is_some(), "rgb needs colours");
        let fast = openness.is_some() && normal.is_none();
        let weighted = rgb.is_some() || normal.is_some();
        let dst_box = self.dst_box;
        let extents = tile_of(dst_box.shape(), weighted);
        for cell in dst_box.cells(dst_box.lo, extents).iter() {
            let tile = Region::of_cell(cell, dst_box.lo, extents).clip(&dst_box);
            let tile = needed.map_or(tile, |mask| wanted::shrink(tile, mask, dst_box));
            if tile.is_empty() {
                continue;
            }
            let needed = needed.map(|mask| mask.part(dst_box.offset_of(&tile), tile.shape()));
            let len = |frame: usize| if fast { sinks::sums_len(tile.shape(), FRAMES[frame]) } else { 0 };
            let (natural, rest) = carve::<u32>(&mut *bytes, len(0));
            let (turned, rest) = carve::<u32>(rest, len(1));
            let sums = [natural, turned];
            let lens = FRAMES.map(|frame| sinks::sums_len(tile.shape(), frame));
            let used = |yes: bool| if yes { lens } else { [0; 2] };
            let (weights, rest) = weighted::pair(rest, used(normal.is_some()));
            let (open, rest) = weighted::pair(rest, used(normal.is_some()));
            let (red, rest) = weighted::pair(rest, used(rgb.is_some()));
            let (green, rest) = weighted::pair(rest, used(rgb.is_some()));
            let (blue, _) = weighted::pair(rest, used(rgb.is_some()));
            let mut fast_sum = OpenSum { level: self.level, sums, tile };
            fast_sum.clear();
            let mut wide_sum = WeightedSum {
                level: self.level,
                tile,
                dst_box,
                src_box: self.src_box,
                normal,
                flipped: self.prepared.params.flipped,
                uniform: self.prepared.uniform,
                weights,
                open,
                ambient: self.prepared.params.ambient,
                colour: colour.filter(|_| rgb.is_some()),
                rgb: [red, green, blue],
            };
            wide_sum.clear();
            match (fast, weighted) {
                (true, false) if self.flat => {}
                (true, false) => self.sweep_tile(tile, needed, &mut fast_sum),
                (false, true) => self.sweep_tile(tile, needed, &mut wide_sum),
                (true, true) => {
                    let mut both = (fast_sum, wide_sum);
                    self.sweep_tile(tile, needed, &mut both);
                    (fast_sum, wide_sum) = both;
                }
                (false, false) => return,
            }
            if fast && !self.flat {
                fast_sum.merge();
            }
            wide_sum.merge();
            let total = self.prepared.total;
            let [nz, ny, nx] = tile.shape();
            let at = dst_box.offset_of(&tile);
            for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
                let gone = |row: &mut [f32]| gone([tile.lo[0] + z as i64, tile.lo[1] + y as i64, tile.lo[2]], row);
                if let Some(out) = &mut openness {
                    let row = &mut out.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
                    match fast {
                        true if self.flat => row.fill(1.0),
                        true => fast_sum.openness([z, y], 0, total, row),
                        false => wide_sum.openness([z, y], row),
                    }
                    gone(row);
                }
                for (c, out) in rgb.iter_mut().flatten().enumerate() {
                    let row = &mut out.row_at(at[0] + z, at[1] + y)[at[2]..at[2] + nx];
                    wide_sum.colour_of([z, y], c, row);
                    gone(row);
                }
            }
        }
    }

    fn sweep_tile<S: Sink>(&mut self, tile: Region, needed: Option<View<u8>>, sink: &mut S) {
        let Pass { masks: [natural, turned], counts, .. } = self;
        let wanted = needed.map(|needed| Wanted::both(needed, natural, turned));
        for group in driver::groups(&self.prepared.families) {
            let frame = driver::frame_of(&group[0]);
            let volume = Volume::new(self.keys.in_frame(frame), in_frame(self.src_box, FRAMES[frame]));
            let most = if self.flat { 0 } else { usize::MAX };
            *counts += driver::sweep_group(
                self.level,
                group,
                most,
                volume,
                tile,
                wanted.map(|w| w[frame]),
                &mut self.buffers,
                sink,
            );
        }
    }
}

/// NaN where a voxel of a row is missing.
fn mark_missing<T: Coded>(voxels: &[T], missing: Option<T>, row: &mut [f32]) {
    for (out, &v) in row.iter_mut().zip(voxels) {
        *out = if keys::is_missing(v, missing) { f32::NAN } else { *out };
    }
}

fn f32_view(view: AnyViewMut) -> ViewMut<f32> {
    match view {
        AnyViewMut::F32(v) => v,
        other => panic!("obscurance writes f32, not {}", other.dtype()),
    }
}
