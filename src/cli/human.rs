//! Numbers as people read them.

/// `1536` to `1.50 KiB`.
pub fn bytes(n: u64) -> String {
    let units = ["KiB", "MiB", "GiB", "TiB", "PiB", "EiB"];
    let (mut value, mut unit) = (n as f64, "B");
    for next in units {
        if value < 1024.0 {
            break;
        }
        value /= 1024.0;
        unit = next;
    }
    if unit == "B" { format!("{n} B") } else { format!("{value:.2} {unit}") }
}

/// `1234567` to `1.23 M`.
pub fn count(n: f64) -> String {
    let (value, unit) = match n {
        n if n >= 1e12 => (n / 1e12, " T"),
        n if n >= 1e9 => (n / 1e9, " G"),
        n if n >= 1e6 => (n / 1e6, " M"),
        n if n >= 1e3 => (n / 1e3, " k"),
        n => (n, ""),
    };
    if unit.is_empty() { format!("{value:.0}") } else { format!("{value:.2}{unit}") }
}

/// `75.3` to `1 min 15 s`.
pub fn seconds(s: f64) -> String {
    match s {
        s if !s.is_finite() || s < 0.0 => "?".into(),
        s if s < 1.0 => format!("{:.0} ms", s * 1e3),
        s if s < 60.0 => format!("{s:.1} s"),
        s if s < 3600.0 => format!("{} min {} s", (s / 60.0) as u64, (s % 60.0) as u64),
        s => format!("{} h {} min", (s / 3600.0) as u64, (s % 3600.0 / 60.0) as u64),
    }
}

/// At most six digits that matter, without trailing zeros.
pub fn number(v: f64) -> String {
    if !v.is_finite() {
        return format!("{v}");
    }
    let magnitude = v.abs();
    if v == 0.0 {
        return "0".into();
    }
    if !(1e-4..1e9).contains(&magnitude) {
        return format!("{v:.5e}");
    }
    let digits = (5 - magnitude.log10().floor() as i32).clamp(0, 12) as usize;
    let text = format!("{v:.digits$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_string(),
        false => text,
    }
}

/// `[113, 256, 256]` to `113 x 256 x 256`.
pub fn extent(shape: [usize; 3]) -> String {
    shape.map(|n| n.to_string()).join(" x ")
}

#[cfg(test)]
mod tests {
    #[test]
    fn numbers_are_short() {
        assert_eq!(super::bytes(0), "0 B");
        assert_eq!(super::bytes(1536), "1.50 KiB");
        assert_eq!(super::bytes(u64::MAX), "16.00 EiB");
        assert_eq!(super::count(1_234_567.0), "1.23 M");
        assert_eq!(super::seconds(75.3), "1 min 15 s");
        for (v, text) in [(0.0, "0"), (1.0, "1"), (0.1234567, "0.123457"), (-3272.0, "-3272"), (1e-7, "1.00000e-7")] {
            assert_eq!(super::number(v), text);
        }
    }
}
