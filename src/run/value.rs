//! What a wire holds for one brick.

use crate::brick::{Pool, Voxels, gather};
use crate::grid::{AnyView, DType, Region, Voxel};

/// One component over a box: one number, or voxels.
#[derive(Debug)]
pub enum Comp {
    /// Every voxel has this stored value (exact in f64 for every element type).
    Const(f64),
    Voxels(Voxels),
}

/// A wire's components over a box.
#[derive(Debug)]
pub struct Value {
    pub dtype: DType,
    pub region: Region,
    pub comps: Vec<Comp>,
}

impl Value {
    pub fn constant(dtype: DType, region: Region, comps: usize, value: f64) -> Value {
        Value { dtype, region, comps: (0..comps).map(|_| Comp::Const(value)).collect() }
    }

    /// The constants, if no component has voxels.
    pub fn constants(&self) -> Option<Vec<f64>> {
        self.comps.iter().map(|c| if let Comp::Const(v) = c { Some(*v) } else { None }).collect()
    }

    /// Turns constants into voxels, for kernels that mix them with others.
    pub fn materialize(&mut self, pool: &Pool) {
        let len = self.region.voxels();
        for comp in &mut self.comps {
            if let Comp::Const(value) = *comp {
                let mut buffer = pool.take(self.dtype, len);
                buffer.fill(value);
                *comp = Comp::Voxels(buffer);
            }
        }
    }

    /// The voxels of `part` (inside the value's box) of one component. Panics if that is a constant.
    pub fn view(&self, comp: usize, part: Region) -> AnyView<'_> {
        let Comp::Voxels(v) = &self.comps[comp] else { panic!("a constant has no voxels; materialize it first") };
        v.view(self.region.shape()).part(self.region.offset_of(&part), part.shape())
    }

    /// Gives the buffers back.
    pub fn recycle(self, pool: &Pool) {
        for comp in self.comps {
            if let Comp::Voxels(v) = comp {
                pool.put(v);
            }
        }
    }
}

/// The one value that all voxels share bit for bit, if they do.
pub fn common_value(view: AnyView) -> Option<f64> {
    fn same<T: Voxel + Bits>(v: crate::grid::View<T>) -> Option<f64> {
        let first = v.row_at(0, 0)[0].bits();
        for z in 0..v.shape[0] {
            for y in 0..v.shape[1] {
                // In blocks, so that the comparison runs wide and still stops early.
                for block in v.row_at(z, y).chunks(256) {
                    if block.iter().fold(0, |d, x| d | (x.bits() ^ first)) != 0 {
                        return None;
                    }
                }
            }
        }
        Some(v.row_at(0, 0)[0].to_f64())
    }
    if view.shape().contains(&0) {
        return None;
    }
    crate::with_view!(AnyView, view, v => same(v))
}

/// Bit pattern of a voxel, so that NaN equals itself and -0 differs from 0.
trait Bits: Copy {
    fn bits(self) -> u64;
}

macro_rules! bits {
    ($($t:ty => $e:expr;)*) => {$(impl Bits for $t {
        #[inline(always)]
        fn bits(self) -> u64 { ($e)(self) }
    })*};
}
bits! {
    u8 => |v| v as u64; i8 => |v| v as u8 as u64; u16 => |v| v as u64; i16 => |v| v as u16 as u64;
    u32 => |v| v as u64; i32 => |v| v as u32 as u64; f32 => |v: f32| v.to_bits() as u64; f64 => f64::to_bits;
}

/// Copies the common part of a value's component into a dense buffer of `to`.
pub fn copy_into(src: AnyView, src_box: Region, dst: &mut Voxels, to: Region) {
    gather::copy_common(src, src_box, dst.view_mut(to.shape()), to);
}
