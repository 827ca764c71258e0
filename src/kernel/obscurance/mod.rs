//! Obscurance sweeps along parallel lattice lines (paper B; SPEC section 4).
//!
//! | file | holds |
//! |---|---|
//! | `lines` | directions to families of lines, distances, fixed-point contributions |
//! | `keys` | voxels to padded, order-preserving unsigned keys |
//! | `tiles` | tiles of an output box, their sums and results |
//! | `driver` | sheets, senses |
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
mod tiles;
#[cfg(target_arch = "x86_64")]
mod turn;
mod wanted;
mod weighted;
#[cfg(target_arch = "x86_64")]
mod wide;

use std::convert::Infallible;

use super::Context;
use crate::brick::scratch::cut;
use crate::grid::{AnyView, AnyViewMut, DType, Region, Shape, View, ViewMut};
use crate::kernel::simd::Level;
use crate::stage::{DirectionSet, DirectionWeights, Rho};
use crate::with_view;
use driver::{FRAMES, in_frame};
use keys::{Code, Coded, Key, Volume};
use room::Sizes;
use tiles::{Pass, Supply, tile_of};

pub use lines::{is_valid_count, rho};
pub use ranks::Ranks;
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
    /// Voxels are compared by these instead of their values: what is swept is a function of an 8- or 16-bit volume, such as
    /// the opacity that a transfer table makes of it. The volume must have the type.
    pub ranks: Option<Ranks>,
}

/// Directions, lines and tables made once from the parameters.
#[derive(Debug, Clone, PartialEq)]
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

impl Prepared {
    /// For volumes of any extent. Panics on a spacing or distance that is not positive.
    pub fn new(params: &ObscuranceParams) -> Prepared {
        Prepared::within(params, [usize::MAX; 3])
    }

    /// For a volume of this shape: tables end where it does, whatever `max_distance` says. Panics as [`Prepared::new`].
    pub fn within(params: &ObscuranceParams, volume: Shape) -> Prepared {
        assert!(params.spacing.iter().all(|s| *s > 0.0 && s.is_finite()), "spacing {:?}", params.spacing);
        assert!(params.max_distance >= 0.0, "max_distance {}", params.max_distance);
        let (mut families, total) = lines::families(params, volume);
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
            let (codes, rest) = cut::<u8>(&mut *bytes, src_box.voxels());
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
        let (natural_mask, bytes) = cut::<u64>(bytes, words[0]);
        let (turned_mask, bytes) = cut::<u64>(bytes, words[1]);
        let (natural, bytes) = cut::<T::Key>(bytes, sizes.keys[0]);
        let (swapped, bytes) = cut::<T::Key>(bytes, sizes.keys[1]);
        let (buffers, bytes) = sizes.buffers::<T::Key>(bytes);

        let code = Code::new(&self.params);
        let most = keys::encode(level, src, code, natural);
        let mut copies = Copies {
            level,
            src,
            region: src_box,
            code,
            shared: swapped.is_empty(),
            keys: [natural, swapped],
            hold: [Some(0), None],
            most,
            least: T::Key::MAX,
        };
        let masks = [natural_mask, turned_mask];
        let counts = LineCounts::default();
        let mut pass = Pass { prepared: self, level, src_box, dst_box, buffers, masks, counts, flat: true };
        let Ok(()) = pass.run::<Infallible>(io, &mut copies, bytes);
        pass.counts
    }
}

/// Padded copies of a source in the order of each frame. A sweep of one tile needs one after the other, in one place.
struct Copies<'a, T: Coded> {
    level: Level,
    src: View<'a, T>,
    region: Region,
    code: Code<'a, T>,
    keys: [&'a mut [T::Key]; 2],
    shared: bool,
    /// The frame that each copy is in.
    hold: [Option<usize>; 2],
    /// Greatest key of the source, and least of the tile.
    most: T::Key,
    least: T::Key,
}

impl<T: Coded> Supply<T::Key, Infallible> for Copies<'_, T> {
    fn enter(&mut self, tile: Region) {
        let part = self.src.part(self.region.offset_of(&tile), tile.shape());
        self.least = keys::least(self.level, part, self.code);
    }

    fn keys(&mut self, group: &[lines::Family], _: Region) -> Result<(Volume<'_, T::Key>, bool), Infallible> {
        let frame = driver::frame_of(&group[0]);
        let place = if self.shared { 0 } else { frame };
        let busy = self.most > self.least;
        if busy && self.hold[place] != Some(frame) {
            match frame {
                0 => _ = keys::encode(self.level, self.src, self.code, self.keys[place]),
                _ => keys::encode_turned(self.level, self.src, self.code, self.keys[place]),
            }
            self.hold[place] = Some(frame);
        }
        Ok((Volume::new(self.keys[place], in_frame(self.region, FRAMES[frame])), busy))
    }

    fn mark_missing(&self, at: [i64; 3], row: &mut [f32]) {
        let [z, y, x] = self.region.offset_of(&Region::new(at, at));
        mark_missing(&self.src.row_at(z, y)[x..], self.code.missing, row);
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
