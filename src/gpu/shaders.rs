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

/// Van Herk over windows, of cells that a file keeps, with how it goes along z and y and what else it needs.
macro_rules! herk {
    ($($more:literal),*; $own:literal) => {
        composed!(
            "common", "entry_first", "entry_next", "window_pass", "window_lines", "window_tiles", "window_herk_rows",
            $($more,)* $own
        )
    };
}

/// Gaussians, a thread of each line, made by a file.
macro_rules! gaussian {
    ($own:literal) => {
        composed!(
            "common",
            "floats",
            "pairs",
            "cells",
            "entry_first",
            "entry_next",
            "gaussian_taps",
            "gaussian_centres",
            $own
        )
    };
}

/// The shaders, each with its text and entry points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Shader {
    ExtremesZ,
    ExtremesY,
    /// Along x.
    Extremes,
    SumsZ,
    SumsY,
    /// Along x.
    Sums32,
    Sums64,
    /// Of codes of 8 and 16 bits.
    Obscurance,
    /// Of codes of 32 bits.
    ObscuranceWide,
    Gaussian,
    /// Along x.
    GaussianRows,
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
    pub const ALL: [Shader; 26] = [
        Shader::ExtremesZ,
        Shader::ExtremesY,
        Shader::Extremes,
        Shader::SumsZ,
        Shader::SumsY,
        Shader::Sums32,
        Shader::Sums64,
        Shader::Obscurance,
        Shader::ObscuranceWide,
        Shader::Gaussian,
        Shader::GaussianRows,
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
            Shader::ExtremesZ => composed!(
                "common",
                "entry_first",
                "window_pass",
                "window_lines",
                "window_herk_ahead",
                "window_kept",
                "window_fours_packed",
                "window_extremes_four",
                "window_extremes_z"
            ),
            Shader::ExtremesY => composed!(
                "common",
                "entry_next",
                "window_pass",
                "window_lines",
                "window_herk_ahead",
                "window_kept",
                "window_extremes_four",
                "window_extremes_left",
                "window_extremes_y"
            ),
            Shader::Extremes => composed!(
                "common",
                "window_pass",
                "window_tiles",
                "window_herk_rows",
                "window_thirds",
                "window_kept",
                "window_extremes_left",
                "window_extremes"
            ),
            Shader::SumsZ => composed!(
                "common",
                "entry_first",
                "window_pass",
                "window_lines",
                "window_sums",
                "window_sums_plain",
                "window_fours_packed",
                "window_sums_z"
            ),
            Shader::SumsY => {
                composed!(
                    "common",
                    "entry_next",
                    "window_pass",
                    "window_lines",
                    "window_sums",
                    "window_sums_plain",
                    "window_sums_left",
                    "window_sums_y"
                )
            }
            Shader::Sums32 => composed!(
                "common",
                "window_pass",
                "window_scan",
                "window_sums_plain",
                "window_sums_left",
                "window_sums32"
            ),
            Shader::Sums64 => composed!(
                "common",
                "entry_first",
                "entry_next",
                "window_pass",
                "window_lines",
                "window_sums",
                "window_scan",
                "window_sums64"
            ),
            Shader::Obscurance => composed!("common", "obscurance_narrow", "obscurance"),
            Shader::ObscuranceWide => composed!("common", "obscurance_wide", "obscurance"),
            Shader::Gaussian => gaussian!("gaussian"),
            Shader::GaussianRows => {
                composed!("common", "floats", "pairs", "cells", "gaussian_taps", "gaussian_rows")
            }
            Shader::Gradient => composed!("common", "gradient"),
            Shader::Order => herk!("window_herk_ahead", "window_thirds", "window_kept"; "window_order"),
            Shader::Moments => herk!("window_herk", "floats", "pairs"; "window_moments"),
            Shader::GaussianVariance => gaussian!("gaussian_variance"),
            Shader::MapPool => composed!("common", "floats", "pairs", "cells", "entry_first", "entry_next", "map_pool"),
            Shader::Finish => composed!("common", "floats", "pairs", "estimators", "window_finish"),
            Shader::Codes => composed!("common", "integers64", "double", "estimators", "window_codes"),
            Shader::LevelPool => {
                composed!("common", "integers64", "double", "entry_first", "entry_next", "level_cells", "level_pool")
            }
            Shader::LevelWrite => {
                composed!("common", "integers64", "double", "entry_first", "entry_next", "level_cells", "level_write")
            }
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
            Shader::ExtremesZ | Shader::SumsZ => &["first"],
            Shader::ExtremesY | Shader::SumsY => &["next"],
            Shader::GaussianRows => &["rows"],
            Shader::Extremes => &["rows", "near"],
            Shader::Sums32 => &["rows"],
            Shader::Sums64 | Shader::Moments => &["first", "next", "rows"],
            Shader::Order => &["first", "next", "rows", "near"],
            _ => &["first", "next"],
        }
    }

    /// Whether `parts`, an overridable constant of it, says what is compiled: what nobody asks for takes registers, and threads
    /// off the device.
    pub fn has_parts(self) -> bool {
        matches!(self, Shader::Codes | Shader::SumsZ | Shader::ExtremesZ)
    }

    /// Whether a thread of this entry that has done its work goes on to the next, as many threads on as there are.
    pub fn goes_on(self, entry: usize) -> bool {
        let alone = matches!(self, Shader::Codes | Shader::Finish | Shader::Point | Shader::Gradient | Shader::Copy);
        match self.entries()[entry] {
            "first" | "next" | "near" => true,
            "rows" => matches!(self, Shader::Sums32 | Shader::Sums64 | Shader::GaussianRows),
            _ => alone,
        }
    }

    /// Storage bindings after the uniform one.
    pub fn bindings(self) -> usize {
        match self {
            Shader::Codes | Shader::Point => 5,
            Shader::Obscurance | Shader::ObscuranceWide | Shader::Finish | Shader::LevelPool => 4,
            Shader::Gaussian | Shader::GaussianRows | Shader::GaussianVariance | Shader::Gradient | Shader::MapPool => {
                3
            }
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
