//! Unit names as files spell them, to UDUNITS names.

/// UDUNITS name of a length unit as files spell it (`mm`, `µm`, `micron`, ...). `None` for an empty name and for
/// "units" that carry no length (`pixel`, `voxel`, `none`); a name that is not known here is kept in lower case.
pub fn normalise(text: &str) -> Option<String> {
    let plain = text.trim().trim_matches('\0').trim_matches('"').trim();
    let plain = plain.replace("\\u00B5", "µ").replace("\\u00b5", "µ").replace('\u{3bc}', "µ");
    // Case carries meaning in `Mm`/`mm` only, which no volume file uses.
    let low = plain.to_lowercase();
    let name = match low.as_str() {
        "" | "pixel" | "pixels" | "voxel" | "voxels" | "px" | "none" | "unknown" | "?" | "arbitrary" | "a.u." => {
            return None;
        }
        "mm" | "millimeter" | "millimeters" | "millimetre" | "millimetres" => "millimeter",
        "um" | "µm" | "micron" | "microns" | "micrometer" | "micrometers" | "micrometre" | "micrometres" => {
            "micrometer"
        }
        "nm" | "nanometer" | "nanometers" | "nanometre" | "nanometres" => "nanometer",
        "pm" | "picometer" | "picometre" => "picometer",
        "cm" | "centimeter" | "centimeters" | "centimetre" | "centimetres" => "centimeter",
        "dm" | "decimeter" | "decimetre" => "decimeter",
        "m" | "meter" | "meters" | "metre" | "metres" => "meter",
        "km" | "kilometer" | "kilometers" | "kilometre" | "kilometres" => "kilometer",
        "a" | "å" | "\u{212b}" | "angstrom" | "angstroms" | "ångström" | "ångstrom" => "angstrom",
        "in" | "inch" | "inches" => "inch",
        "ft" | "foot" | "feet" => "foot",
        other => other,
    };
    Some(name.to_string())
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
