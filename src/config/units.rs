//! Units of length: what users and files write, UDUNITS names, metres.

/// UDUNITS name, metres, other spellings. Case matters only where it must (`mm`, `Mm`).
const UNITS: [(&str, f64, &[&str]); 20] = [
    ("meter", 1.0, &["m", "metre", "meters", "metres"]),
    ("kilometer", 1e3, &["km", "kilometre", "kilometers", "kilometres"]),
    ("hectometer", 1e2, &["hm", "hectometre"]),
    ("decimeter", 1e-1, &["dm", "decimetre", "decimeters", "decimetres"]),
    ("centimeter", 1e-2, &["cm", "centimetre", "centimeters", "centimetres"]),
    ("millimeter", 1e-3, &["mm", "millimetre", "millimeters", "millimetres"]),
    // U+00B5 (micro sign) and U+03BC (Greek mu) look the same and both occur in files.
    (
        "micrometer",
        1e-6,
        &["um", "\u{b5}m", "\u{3bc}m", "micron", "microns", "micrometre", "micrometers", "micrometres", "\\u00B5m"],
    ),
    ("nanometer", 1e-9, &["nm", "nanometre", "nanometers", "nanometres"]),
    ("picometer", 1e-12, &["pm", "picometre", "picometers", "picometres"]),
    ("femtometer", 1e-15, &["fm", "femtometre", "femtometers", "fermi"]),
    ("angstrom", 1e-10, &["\u{c5}", "\u{212b}", "A", "ang", "angstroms", "\u{e5}ngstr\u{f6}m"]),
    ("inch", 0.0254, &["in", "inches", "\""]),
    ("foot", 0.3048, &["ft", "feet"]),
    ("yard", 0.9144, &["yd", "yards"]),
    ("mile", 1609.344, &["mi", "miles"]),
    ("megameter", 1e6, &["Mm", "megametre", "megameters"]),
    ("gigameter", 1e9, &["Gm", "gigametre", "gigameters"]),
    ("terameter", 1e12, &["Tm", "terametre", "terameters"]),
    ("petameter", 1e15, &["Pm", "petametre", "petameters"]),
    ("parsec", 3.085_677_581_491_367e16, &["pc", "parsecs"]),
];

fn entry(text: &str) -> Option<&'static (&'static str, f64, &'static [&'static str])> {
    let text = text.trim();
    UNITS.iter().find(|(name, _, other)| *name == text || other.contains(&text)).or_else(|| {
        // Whole words in any case (`Micron`, `MILLIMETER`); abbreviations keep theirs.
        let lower = text.to_lowercase();
        let words = |(name, _, other): &&(&str, f64, &[&str])| {
            *name == lower || other.iter().any(|o| o.chars().count() > 2 && *o == lower)
        };
        UNITS.iter().find(words).or_else(|| match text {
            "MM" => UNITS.iter().find(|u| u.0 == "millimeter"),
            "CM" => UNITS.iter().find(|u| u.0 == "centimeter"),
            "UM" => UNITS.iter().find(|u| u.0 == "micrometer"),
            "NM" => UNITS.iter().find(|u| u.0 == "nanometer"),
            _ => None,
        })
    })
}

/// Metres of one unit, by any spelling.
pub fn to_metres(unit: &str) -> Option<f64> {
    entry(unit).map(|u| u.1)
}

/// A length in one unit as a number of another: decimal factors are whole numbers, by which 2.5 and 1050 come out as on paper.
pub fn converted(value: f64, from: &str, to: &str) -> Option<f64> {
    let (from, to) = (to_metres(from)?, to_metres(to)?);
    let whole = |ratio: f64| Some(ratio.round()).filter(|r| *r >= 1.0 && (ratio / r - 1.0).abs() < 1e-12);
    Some(match (whole(from / to), whole(to / from)) {
        (Some(times), _) => value * times,
        (None, Some(parts)) => value / parts,
        (None, None) => value * (from / to),
    })
}

/// The UDUNITS name of a unit (`"mm"`, `"µm"`, `"inches"` to `millimeter`, `micrometer`, `inch`).
pub fn udunits_name(text: &str) -> Option<&'static str> {
    entry(text).map(|u| u.0)
}

/// What messages say is accepted.
pub const ACCEPTED: &str = "m, cm, mm, um (micron), nm, pm, angstrom, inch, foot, km or their full names";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spellings_meet_in_one_name() {
        for (text, name, metres) in [
            ("mm", "millimeter", 1e-3),
            ("Millimeter", "millimeter", 1e-3),
            ("MM", "millimeter", 1e-3),
            ("µm", "micrometer", 1e-6),
            ("μm", "micrometer", 1e-6),
            ("micron", "micrometer", 1e-6),
            ("Microns", "micrometer", 1e-6),
            ("Å", "angstrom", 1e-10),
            ("inch", "inch", 0.0254),
            (" nm ", "nanometer", 1e-9),
            ("m", "meter", 1.0),
            ("Mm", "megameter", 1e6),
        ] {
            assert_eq!(udunits_name(text), Some(name), "{text}");
            assert_eq!(to_metres(text), Some(metres), "{text}");
        }
        for bad in ["", "furlong", "pixel", "s", "mmm", "M"] {
            assert_eq!(udunits_name(bad), None, "{bad}");
        }
    }

    #[test]
    fn decimal_factors_are_exact() {
        for (value, from, to, want) in [
            (2.5, "um", "nm", 2500.0),
            (1050.0, "um", "mm", 1.05),
            (525.0, "um", "mm", 0.525),
            (1.5, "inch", "mm", 38.1),
            (7.0, "m", "m", 7.0),
            (3.0, "angstrom", "nm", 0.3),
        ] {
            let got = converted(value, from, to).unwrap();
            assert!((got / want - 1.0).abs() < 1e-15 || got == want, "{value} {from}: {got}");
        }
        assert_eq!(converted(2.5, "um", "nm"), Some(2500.0));
        assert_eq!(converted(1050.0, "um", "mm"), Some(1.05));
        assert_eq!(converted(1.0, "furlong", "mm"), None);
    }

    #[test]
    fn no_spelling_means_two_units() {
        let all: Vec<&str> = UNITS.iter().flat_map(|u| std::iter::once(u.0).chain(u.2.iter().copied())).collect();
        let mut once = all.clone();
        once.sort_unstable();
        once.dedup();
        assert_eq!(once.len(), all.len());
        assert!(all.iter().all(|t| to_metres(t).is_some_and(|m| m > 0.0)));
    }
}
