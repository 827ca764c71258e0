//! Stored to scaled values.

/// `scaled = slope * stored + intercept`, as NIfTI and DICOM use the words.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    pub slope: f64,
    pub intercept: f64,
}

impl Affine {
    pub const IDENTITY: Affine = Affine { slope: 1.0, intercept: 0.0 };

    /// A slope of 0 or NaN means "no scaling", as NIfTI has it; a NaN intercept counts as 0.
    pub fn new(slope: f64, intercept: f64) -> Affine {
        if slope == 0.0 || !slope.is_finite() {
            Affine::IDENTITY
        } else {
            Affine { slope, intercept: if intercept.is_finite() { intercept } else { 0.0 } }
        }
    }

    pub fn is_identity(self) -> bool {
        self == Affine::IDENTITY
    }

    /// Scaled value of a stored one.
    #[inline]
    pub fn apply(self, stored: f64) -> f64 {
        self.slope * stored + self.intercept
    }

    /// Stored value (not rounded) of a scaled one.
    #[inline]
    pub fn invert(self, scaled: f64) -> f64 {
        (scaled - self.intercept) / self.slope
    }
}
