//! Chunks of Zarr arrays that are stored with their axes in another order (`order = "F"` of v2, the `transpose` codec of v3).
//!
//! The library puts voxels in order one by one, across whole chunks: 60 (f32, chunks of 64^3) to 230 ns (of 256^3) a voxel where the
//! rest of a run takes 10 to 20 (2-core Intel Xeon VM, 2026-11-28). Here they are moved in tiles that stay in the first-level cache.

use std::sync::Arc;

use zarrs::array::CodecMetadataOptions;
use zarrs::array::codec::CodecChain;

/// Edge of a tile: 32 lines of 32 voxels are 16 cache lines of bytes to 64 of f64, twice.
const TILE: usize = 32;

/// Takes the transposition off a chain that has one and nothing else before its bytes. With it comes the order of the stored axes:
/// stored axis `i` is axis `order[i]` of the array.
pub fn take(codecs: Arc<CodecChain>) -> (Arc<CodecChain>, Option<Vec<usize>>) {
    if codecs.array_to_array_codecs().len() != 1 {
        return (codecs, None);
    }
    let described = codecs.create_metadatas(&CodecMetadataOptions::default());
    let order = described.first().filter(|c| c.name() == "transpose").and_then(|c| {
        let value = serde_json::to_value(c).ok()?;
        serde_json::from_value::<Vec<usize>>(value["configuration"]["order"].clone()).ok()
    });
    let Some(order) = order else { return (codecs, None) };
    let (to_bytes, after) = (codecs.array_to_bytes_codec().clone(), codecs.bytes_to_bytes_codecs().to_vec());
    (Arc::new(CodecChain::new(vec![], to_bytes, after)), Some(order))
}

/// The shape that a chunk of this shape is stored in.
pub fn stored_shape<T: Copy>(shape: &[T], order: &[usize]) -> Vec<T> {
    order.iter().map(|&a| shape[a]).collect()
}

/// Voxels from one to the next along each axis of the array, in a chunk of `shape` that is stored in `order`.
pub fn strides(shape: &[u64], order: &[usize]) -> Vec<usize> {
    let mut strides = vec![0; shape.len()];
    let mut stride = 1;
    for &axis in order.iter().rev() {
        strides[axis] = stride;
        stride *= shape[axis] as usize;
    }
    strides
}

/// Copies a box of voxels of `N` bytes, `strides` apart from `start` of `src` on, to dense `dst`, z, y, x. Panics if `src` ends
/// before the box does.
fn copy<const N: usize>(src: &[[u8; N]], start: usize, strides: [usize; 3], dst: &mut [[u8; N]], shape: [usize; 3]) {
    let [nz, ny, nx] = shape;
    let tiles = |n: usize| (0..n).step_by(TILE).map(move |i| i..(i + TILE).min(n));
    // A row of `src` runs along the axis whose voxels are neighbours: tiles lie across that and x.
    let near = if strides[0] < strides[1] { 0 } else { 1 };
    let (far, [n_near, n_far]) = (1 - near, if near == 0 { [nz, ny] } else { [ny, nz] });
    let to = [ny * nx, nx];
    for f in 0..n_far {
        for near_tile in tiles(n_near) {
            for x_tile in tiles(nx) {
                for n in near_tile.clone() {
                    let from = start + f * strides[far] + n * strides[near];
                    let row = &mut dst[f * to[far] + n * to[near]..][..nx];
                    for x in x_tile.clone() {
                        row[x] = src[from + x * strides[2]];
                    }
                }
            }
        }
    }
}

/// As [`copy`], of voxels of `size` bytes.
pub fn copy_bytes(src: &[u8], size: usize, start: usize, strides: [usize; 3], dst: &mut [u8], shape: [usize; 3]) {
    macro_rules! of {
        ($n:literal) => {
            copy::<$n>(src.as_chunks().0, start, strides, dst.as_chunks_mut().0, shape)
        };
    }
    match size {
        1 => of!(1),
        2 => of!(2),
        4 => of!(4),
        8 => of!(8),
        _ => unreachable!("voxels have 1, 2, 4 or 8 bytes"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_order_comes_back() {
        for shape in [[3u64, 5, 7], [1, 40, 70], [33, 1, 65], [64, 34, 2]] {
            let [nz, ny, nx] = shape.map(|n| n as usize);
            for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                let by = strides(&shape, &order);
                let stored: usize = stored_shape(&shape, &order).iter().product::<u64>() as usize;
                let mut src = vec![0u16; stored];
                let number = |z: usize, y: usize, x: usize| ((z * ny + y) * nx + x) as u16;
                for i in 0..nz * ny * nx {
                    let [z, y, x] = [i / (ny * nx), i / nx % ny, i % nx];
                    src[z * by[0] + y * by[1] + x * by[2]] = number(z, y, x);
                }
                let mut dst = vec![0u16; stored];
                let (from, to) = (bytemuck::cast_slice(&src), bytemuck::cast_slice_mut(&mut dst));
                copy_bytes(from, 2, 0, [by[0], by[1], by[2]], to, shape.map(|n| n as usize));
                assert!(dst.iter().enumerate().all(|(i, v)| *v as usize == i), "{shape:?} {order:?}");
            }
        }
    }
}
