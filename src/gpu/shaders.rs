//! The shaders: texts put together of the files under `shaders/`, entry points, bindings.

/// A text and the files that it is made of, without their ending, in their order.
struct Composed {
    files: &'static [&'static str],
    text: &'static str,
}

/// WGSL has no include: what shaders share stands before them.
macro_rules! composed {
    ($($file:literal),*) => {
        Composed {
            files: &[$($file),*],
            text: concat!($(include_str!(concat!("../../shaders/", $file, ".wgsl")), "\n"),*),
        }
    };
}

/// Running sums of windows, of the type of a file.
macro_rules! sums {
    ($own:literal) => {
        composed!("common", "entries", "window_pass", "window_sums", "window_tiles", "window_sums_rows", $own)
    };
}

/// Van Herk over windows, of cells that a file keeps, with what else it needs.
macro_rules! herk {
    ($($more:literal),*; $own:literal) => {
        composed!("common", $($more,)* "entries", "window_pass", "window_herk", "window_tiles", "window_herk_rows", $own)
    };
}

/// The shaders, each with its text and entry points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Shader {
    Extremes,
    Sums32,
    Sums64,
    /// Of codes of 8 and 16 bits.
    Obscurance,
    /// Of codes of 32 bits.
    ObscuranceWide,
    Gaussian,
    Gradient,
    Order,
    Moments,
    GaussianVariance,
    Finish,
    MapPool,
    Codes,
    LevelPool,
    LevelWrite,
    Point,
    Marks,
    Masked,
    Extend,
    SweepCodes,
    Copy,
}

impl Shader {
    pub const ALL: [Shader; 21] = [
        Shader::Extremes,
        Shader::Sums32,
        Shader::Sums64,
        Shader::Obscurance,
        Shader::ObscuranceWide,
        Shader::Gaussian,
        Shader::Gradient,
        Shader::Order,
        Shader::Moments,
        Shader::GaussianVariance,
        Shader::Finish,
        Shader::MapPool,
        Shader::Codes,
        Shader::LevelPool,
        Shader::LevelWrite,
        Shader::Point,
        Shader::Marks,
        Shader::Masked,
        Shader::Extend,
        Shader::SweepCodes,
        Shader::Copy,
    ];

    fn composed(self) -> Composed {
        match self {
            Shader::Extremes => herk!("window_kept"; "window_extremes"),
            Shader::Sums32 => sums!("window_sums32"),
            Shader::Sums64 => sums!("window_sums64"),
            Shader::Obscurance => composed!("common", "obscurance_narrow", "obscurance"),
            Shader::ObscuranceWide => composed!("common", "obscurance_wide", "obscurance"),
            Shader::Gaussian => composed!("common", "floats", "pairs", "cells", "entries", "gaussian_taps", "gaussian"),
            Shader::Gradient => composed!("common", "gradient"),
            Shader::Order => herk!("window_kept"; "window_order"),
            Shader::Moments => herk!("floats", "pairs"; "window_moments"),
            Shader::GaussianVariance => {
                composed!("common", "floats", "pairs", "cells", "entries", "gaussian_taps", "gaussian_variance")
            }
            Shader::MapPool => composed!("common", "floats", "pairs", "cells", "entries", "map_pool"),
            Shader::Finish => composed!("common", "floats", "pairs", "estimators", "window_finish"),
            Shader::Codes => composed!("common", "integers64", "double", "estimators", "window_codes"),
            Shader::LevelPool => composed!("common", "integers64", "double", "entries", "level_cells", "level_pool"),
            Shader::LevelWrite => composed!("common", "integers64", "double", "entries", "level_cells", "level_write"),
            Shader::Point => composed!("common", "integers64", "double", "point"),
            Shader::Marks => composed!("common", "marks"),
            Shader::Masked => composed!("common", "masked"),
            Shader::Extend => composed!("common", "extend"),
            Shader::SweepCodes => composed!("common", "sweep_codes"),
            Shader::Copy => composed!("common", "copy"),
        }
    }

    /// Names of its files under `shaders/`, without the ending, in the order in which they are put together.
    pub fn files(self) -> &'static [&'static str] {
        self.composed().files
    }

    /// Its own file's name, the last one.
    pub fn name(self) -> &'static str {
        self.files().last().expect("a shader has a file")
    }

    pub fn text(self) -> &'static str {
        self.composed().text
    }

    pub fn entries(self) -> &'static [&'static str] {
        match self {
            Shader::Obscurance | Shader::ObscuranceWide => &["sweep"],
            Shader::Gradient => &["slopes"],
            Shader::Finish | Shader::Codes => &["finish"],
            Shader::Point => &["point"],
            Shader::Marks => &["look"],
            Shader::Masked => &["fill"],
            Shader::Extend => &["extend"],
            Shader::SweepCodes => &["code"],
            Shader::Copy => &["copy"],
            Shader::Extremes | Shader::Sums32 | Shader::Sums64 | Shader::Order | Shader::Moments => {
                &["first", "next", "rows"]
            }
            _ => &["first", "next"],
        }
    }

    /// Whether `parts`, an overridable constant of it, says what is compiled: what nobody asks for takes registers, and threads
    /// off the device.
    pub fn has_parts(self) -> bool {
        self == Shader::Codes
    }

    /// Whether a thread of this entry that has done its work goes on to the next, as many threads on as there are.
    pub fn goes_on(self, entry: usize) -> bool {
        let alone = matches!(self, Shader::Codes | Shader::Finish | Shader::Point | Shader::Gradient | Shader::Copy);
        alone || matches!(self.entries()[entry], "first" | "next")
    }

    /// Storage bindings after the uniform one.
    pub fn bindings(self) -> usize {
        match self {
            Shader::Codes | Shader::Point => 5,
            Shader::Obscurance | Shader::ObscuranceWide | Shader::Finish | Shader::LevelPool => 4,
            Shader::Gaussian | Shader::GaussianVariance | Shader::Gradient | Shader::MapPool => 3,
            _ => 2,
        }
    }

    /// Whether a binding, counted from 1, is written: the second one, and the links of lines.
    pub fn writes(self, binding: usize) -> bool {
        binding == 2 || (binding == 4 && matches!(self, Shader::Obscurance | Shader::ObscuranceWide))
    }
}

/// Most storage bindings of a shader; every adapter has more.
pub const MOST_BINDINGS: u32 = 5;
