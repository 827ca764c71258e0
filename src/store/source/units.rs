//! Unit names as files spell them, to UDUNITS names.

use crate::config::units::{converted, udunits_name};

/// UDUNITS name of a length unit as files spell it (`mm`, `µm`, `micron`, ...). `None` for an empty name and for
/// "units" that carry no length (`pixel`, `voxel`, `none`); a name that is not known here is kept in lower case.
pub fn normalise(text: &str) -> Option<String> {
    let plain = text.trim().trim_matches('\0').trim_matches('"').trim();
    let low = plain.to_lowercase();
    let lengthless = ["", "pixel", "pixels", "voxel", "voxels", "px", "none", "unknown", "?", "arbitrary", "a.u."];
    if lengthless.contains(&low.as_str()) {
        return None;
    }
    // Files shout (`MM`, `UM`) where no volume means megametres.
    let known = udunits_name(plain).filter(|_| plain != "Mm").or_else(|| udunits_name(&low));
    let escaped = || udunits_name(&plain.replace("\\u00b5", "\u{b5}").replace("\\u00B5", "\u{b5}"));
    Some(known.or_else(escaped).map_or(low, str::to_string))
}

/// A length in `own` units as a number of `unit`: axes of one volume may have units of their own.
///
/// # Errors
/// Says which units cannot be brought together.
pub fn to_one(value: f64, unit: Option<&str>, own: Option<&str>) -> Result<f64, String> {
    if unit == own {
        return Ok(value);
    }
    unit.zip(own).and_then(|(unit, own)| converted(value, own, unit)).ok_or_else(|| {
        let [unit, own] = [unit, own].map(|u| u.unwrap_or("none"));
        format!("its axes have different units ({unit}, {own}), which cannot be brought to one; write one unit into it")
    })
}

#[cfg(test)]
mod tests {
    use super::{normalise, to_one};

    #[test]
    fn lengths_come_to_one_unit() {
        assert_eq!(to_one(2.5, Some("micrometer"), Some("micrometer")), Ok(2.5));
        assert_eq!(to_one(1.0, Some("parsec"), Some("parsec")), Ok(1.0));
        assert_eq!(to_one(2.5, Some("nanometer"), Some("micrometer")), Ok(2500.0));
        assert_eq!(to_one(1.0, Some("micrometer"), Some("nanometer")), Ok(1e-3));
        assert!(to_one(1.0, Some("micrometer"), None).unwrap_err().contains("(micrometer, none)"));
        assert!(to_one(1.0, Some("furlong"), Some("micrometer")).is_err());
    }

    #[test]
    fn spellings_of_one_unit_agree() {
        for text in ["um", "µm", "\u{3bc}m", "\\u00B5m", "micron", "Micrometer", " \"um\" ", "micrometre"] {
            assert_eq!(normalise(text).as_deref(), Some("micrometer"), "{text}");
        }
        assert_eq!(normalise("mm").as_deref(), Some("millimeter"));
        assert_eq!(normalise("\u{c5}").as_deref(), Some("angstrom"));
        assert_eq!(normalise("\u{212b}").as_deref(), Some("angstrom"));
        assert_eq!(normalise("parsec").as_deref(), Some("parsec"));
        assert_eq!((normalise("pixel"), normalise(" "), normalise("")), (None, None, None));
    }
}
