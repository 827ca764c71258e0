//! Lengths of the config to voxels, with the spacing that the input reports.

use super::graph::Lattice;
use crate::config::{Length, units};
use crate::{Error, Result};

/// A physical length in units of the lattice's spacing; errors say what unit is not known, and how to give it.
fn physical(value: f64, unit: &str, lattice: &Lattice, key: &str) -> Result<f64> {
    let given = format!("{value} {unit}");
    if units::to_metres(unit).is_none() {
        let message =
            format!("\"{given}\" has an unknown unit; accepted: m, cm, mm, um, nm, angstrom and UDUNITS names");
        return Err(Error::config(key, message));
    }
    let own = lattice.unit.as_deref();
    own.and_then(|own| units::converted(value, unit, own)).ok_or_else(|| {
        let has = own.unwrap_or("none");
        Error::config(
            key,
            format!(
                "the length \"{given}\" needs to know the unit of the spacing, and the input's unit is {has}; \
                 give `unit = \"millimeter\"` (or another UDUNITS length) on the input, or a length in voxels"
            ),
        )
    })
}

/// Rounds half away from zero a positive quotient of decimal numbers, of which binary ones may fall short of a half by a few ulps.
fn round_half_away(voxels: f64) -> f64 {
    (voxels * (1.0 + 1e-9)).round()
}

/// Half-widths in voxels. Physical: `round(R / spacing)` half away from zero, at least 1 on an axis longer than 1.
pub fn radius(length: &Length, lattice: &Lattice, key: &str) -> Result<[usize; 3]> {
    match length {
        Length::Voxels(v) => Ok(v.map(|r| r as usize)),
        Length::Physical { value, unit } => {
            let r = physical(*value, unit, lattice, key)?;
            Ok(std::array::from_fn(|a| {
                let voxels = round_half_away(r / lattice.spacing[a]);
                (voxels.min(1e9) as usize).max(usize::from(lattice.shape[a] > 1))
            }))
        }
    }
}

/// Voxels beyond which a Gaussian is flat over any volume, to every bit of f64; its reach must be an index.
const FLAT: f64 = 1e15;

/// Real widths in voxels per axis.
pub fn sigma(length: &Length, lattice: &Lattice, key: &str) -> Result<[f64; 3]> {
    let sigma = match length {
        Length::Voxels(v) => *v,
        Length::Physical { value, unit } => {
            let s = physical(*value, unit, lattice, key)?;
            lattice.spacing.map(|h| s / h)
        }
    };
    Ok(sigma.map(|s| s.min(FLAT)))
}

/// One distance in voxels of the finest axis.
pub fn distance(length: &Length, lattice: &Lattice, key: &str) -> Result<f64> {
    match length {
        Length::Voxels(v) => Ok(v[0]),
        Length::Physical { value, unit } => {
            let finest = lattice.spacing.into_iter().fold(f64::INFINITY, f64::min);
            Ok(physical(*value, unit, lattice, key)? / finest)
        }
    }
}

/// Half-widths of the box of about the ball's volume: the odd side nearest to 0.806 (2r + 1), at least 3. An axis of
/// radius 0 stays flat.
pub fn equal_volume(radius: [usize; 3]) -> [usize; 3] {
    radius.map(|r| {
        if r == 0 {
            return 0;
        }
        let side = 0.806 * (2 * r + 1) as f64;
        (((side - 1.0) / 2.0).round() as usize).max(1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lattice(spacing: [f64; 3], unit: Option<&str>) -> Lattice {
        Lattice { input: 0, shape: [10, 10, 1], spacing, origin: [0.0; 3], unit: unit.map(str::to_string) }
    }

    #[test]
    fn physical_radii_round_half_away_and_never_vanish_on_long_axes() {
        let r = Length::Physical { value: 2.5, unit: "mm".into() };
        assert_eq!(radius(&r, &lattice([1.0, 10.0, 10.0], Some("millimeter")), "k").unwrap(), [3, 1, 0]);
        assert_eq!(radius(&r, &lattice([1000.0, 500.0, 1.0], Some("micrometer")), "k").unwrap(), [3, 5, 2500]);
        assert!(radius(&r, &lattice([1.0; 3], None), "k").is_err());
    }

    #[test]
    fn one_length_in_two_units_is_one_radius() {
        for (value, spacing, want) in
            [(1.05, 0.3, 4), (1.05, 0.7, 2), (0.525, 0.35, 2), (0.15, 0.1, 2), (0.3, 0.2, 2), (0.29, 0.2, 1)]
        {
            let lattice = lattice([spacing, 1.0, 1.0], Some("millimeter"));
            for (factor, unit) in [(1.0, "mm"), (1e3, "um"), (1e6, "nm")] {
                let r = Length::Physical { value: f64::round(value * factor * 1e6) / 1e6, unit: unit.into() };
                assert_eq!(radius(&r, &lattice, "k").unwrap()[0], want, "{value} mm in {unit}, {spacing} mm");
            }
        }
        let inch = Length::Physical { value: 1.5, unit: "inch".into() };
        assert_eq!(radius(&inch, &lattice([25.4, 1.0, 1.0], Some("millimeter")), "k").unwrap()[0], 2);
    }

    #[test]
    fn sigma_is_never_too_wide_to_index() {
        let wide = lattice([1.0, 1e-308, 1.0], Some("millimeter"));
        assert_eq!(sigma(&Length::Voxels([2.0, 1e19, 0.5]), &wide, "k").unwrap(), [2.0, FLAT, 0.5]);
        let s = Length::Physical { value: 2.0, unit: "mm".into() };
        assert_eq!(sigma(&s, &wide, "k").unwrap(), [2.0, FLAT, 2.0]);
    }

    #[test]
    fn equal_volume_sides_are_odd_and_near() {
        assert_eq!(equal_volume([10, 5, 1]), [8, 4, 1]); // 16.9 -> 17, 8.9 -> 9, 2.4 -> 3
        assert_eq!(equal_volume([0, 2, 3]), [0, 2, 2]); // 4.03 -> 5 (nearest odd of 3 and 5), 5.64 -> 5
    }
}
