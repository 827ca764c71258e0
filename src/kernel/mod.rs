//! Voxels to voxels on the CPU. Kernels are pure functions over slices: they allocate nothing beyond the scratch they
//! are given, know no scheduler, no files and no clock.
//!
//! Window rule: a kernel's `src` covers the output box grown by the reach and *clipped to the volume*; windows are cut at
//! the edge of `src`, so the edge of the volume needs no special case. Border rules other than `clip` are applied by the
//! caller, who extends `src` with the samples that the rule names.

pub mod convert;
pub mod gaussian;
pub mod gradient;
#[cfg(test)]
pub(crate) mod hostile;
pub mod lanes;
pub mod levels;
pub mod mask;
pub mod moments4;
pub mod obscurance;
pub mod occlusion_map;
pub mod pointwise;
pub mod rank;
pub mod reduce;
pub mod simd;
pub mod singles;
pub mod ssim;
pub(crate) mod values;
pub mod window;

/// What every kernel is given besides its voxels.
pub struct Context<'a> {
    /// Instruction set to use.
    pub level: simd::Level,
    pub scratch: &'a mut crate::brick::Scratch,
}
