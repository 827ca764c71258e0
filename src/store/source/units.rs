//! Unit names as files spell them, to UDUNITS names.

use crate::config::units::udunits_name;

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

#[cfg(test)]
mod tests {
    use super::normalise;

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
