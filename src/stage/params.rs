//! Prepared stage parameters: units resolved to voxels, names to enums. Kernels, planner and tests read these.

use crate::grid::Affine;

/// Estimator of openness from a window (SPEC section 4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// Share of the window's voxels that are not above the centre.
    Exact,
    /// A 3.2: `t^beta`.
    CdfPower,
    /// A 3.3: `Phi((v - mean) / sigma)`.
    GaussianCdf,
    /// E 3.4: one-tailed Chebyshev bound.
    Chebyshev,
    /// Eq. 12 of E as printed.
    ChebyshevLiteral,
    /// Beta distribution on the window's [min, max] with its mean and variance.
    Beta,
    /// Window counts at quantile levels of the whole volume, interpolated between levels.
    Levels,
    /// Middle of the bounds that the window's first four power moments put on the count.
    Moments4,
}

/// A result of [`Method::Moments4`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Bound {
    /// The middle between the other two.
    Openness,
    /// Never above the exact count's openness.
    Lower,
    /// Never below it.
    Upper,
}

/// How voxels equal to the centre count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Ties {
    /// `P(v_i <= v)`.
    #[default]
    Le,
    /// Mean of `P(v_i < v)` and `P(v_i <= v)`.
    Mid,
}

/// Shape of the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WindowShape {
    #[default]
    Box,
    /// Sum over axes of `(d / r)^2 <= 1` (an axis of radius 0 admits only `d = 0`); `exact` only.
    Ball,
}

/// A result of one pass over box windows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum WindowChannel {
    Mean,
    Min,
    Max,
    /// Population variance.
    Variance,
    Std,
    /// `E[v^2]` of the scaled values.
    Moment2,
    /// Openness by a moment method ([`Method::Exact`] has a kernel of its own).
    Openness(Method, Ties),
}

/// Parameters that all window kernels share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowParams {
    /// Half-widths in voxels, `[z, y, x]`; the window has `2r + 1` voxels per axis.
    pub radius: [usize; 3],
    /// Stored to scaled values. Arithmetic runs on stored values, results are scaled.
    pub affine: Affine,
    /// Stored value of integer types that marks a missing voxel; floats use NaN.
    pub missing: Option<i64>,
    /// Solid matter is the *smaller* scaled value (`solid = "low"`).
    pub solid_low: bool,
}

impl WindowParams {
    /// Whether openness treats smaller stored values as denser: `solid = "low"` or a negative slope, not both.
    pub fn flipped(&self) -> bool {
        self.solid_low != (self.affine.slope < 0.0)
    }
}

/// Weights of the 4-D linear regression gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum GradientWeight {
    /// The physical distance, as paper B prints it.
    #[default]
    Distance,
    /// Its inverse.
    Inverse,
}

/// Dimming of an occluder with distance (paper B; 1 is open).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Rho {
    Step,
    Linear,
    Exponential,
    #[default]
    Sqrt,
}

/// Family of sweep directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum DirectionSet {
    #[default]
    Icosahedron,
    Fibonacci,
}

/// Weights of sweep directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum DirectionWeights {
    #[default]
    Uniform,
    Voronoi,
}

/// What happens between the ends of a window of openness (paper B, 5.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WindowMode {
    #[default]
    Keep,
    Stretch,
}

/// How `combine` joins its inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CombineKind {
    Add,
    Multiply,
    Min,
    Max,
    Mean,
}

/// One knot of a transfer table: scaled value, opacity, linear r, g, b.
pub type TransferPoint = [f64; 5];

/// How pyramid cells are made from level-0 voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Reduce {
    #[default]
    Mean,
    Min,
    Max,
    /// The first voxel of each cell.
    Stride,
    /// For `variance` and `std`: mean of variances plus variance of means.
    Moments,
}
