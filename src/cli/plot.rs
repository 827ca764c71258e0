//! One plot: time against error, as SVG.

use std::fmt::Write;

/// A point of the plot.
pub struct Point {
    pub label: String,
    /// Group by which points are coloured.
    pub series: String,
    /// Seconds and error; both at least 0.
    pub at: [f64; 2],
    /// No other point is better in one and as good in the other.
    pub front: bool,
}

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 560.0;
/// Left, right, top, bottom.
const MARGIN: [f64; 4] = [80.0, 220.0, 48.0, 56.0];
/// Okabe and Ito's colours, told apart by everyone.
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

/// Logarithmic axis; values at or below 0 stand at its lower end, which is then marked as 0.
struct Axis {
    lo: f64,
    hi: f64,
    /// Whether something stands there, and whether nothing stands elsewhere.
    zero: bool,
    empty: bool,
}

impl Axis {
    fn of(values: impl Iterator<Item = f64> + Clone) -> Axis {
        let zero = values.clone().any(|v| v <= 0.0);
        let positive = values.filter(|v| *v > 0.0 && v.is_finite());
        let lo = positive.clone().fold(f64::INFINITY, f64::min);
        let hi = positive.fold(0.0, f64::max);
        if lo > hi {
            return Axis { lo: -1.0, hi: 1.0, zero, empty: true };
        }
        let (lo, hi) = (lo.log10(), hi.log10());
        let pad = ((hi - lo) * 0.08).max(0.15);
        Axis { lo: lo - pad, hi: hi + pad, zero, empty: false }
    }

    /// 0 to 1 along the axis.
    fn place(&self, v: f64) -> f64 {
        if v > 0.0 { ((v.log10() - self.lo) / (self.hi - self.lo)).clamp(0.0, 1.0) } else { 0.0 }
    }

    /// 0 where something stands there, and 1, 2 and 5 times powers of ten inside.
    fn ticks(&self) -> Vec<f64> {
        let mut ticks = if self.zero { vec![0.0] } else { Vec::new() };
        if self.empty {
            return ticks;
        }
        let powers = self.lo.floor() as i32..=self.hi.ceil() as i32;
        let wide = self.hi - self.lo > 4.0;
        let steps: &[f64] = if wide { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let all = powers.flat_map(|p| steps.iter().map(move |s| s * 10f64.powi(p)));
        // Numbers beside that of 0 would run into it.
        let least = self.lo + if self.zero { 0.04 * (self.hi - self.lo) } else { 0.0 };
        ticks.extend(all.filter(|t| (least..=self.hi).contains(&t.log10())));
        ticks
    }
}

/// Text that is safe inside SVG.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Draws time (x) against error (y), both logarithmic; points of the front are joined.
pub fn svg(title: &str, x_label: &str, y_label: &str, points: &[Point]) -> String {
    let axes = [0, 1].map(|a| Axis::of(points.iter().map(move |p| p.at[a])));
    let x = |v: f64| MARGIN[0] + axes[0].place(v) * (WIDTH - MARGIN[0] - MARGIN[1]);
    let y = |v: f64| HEIGHT - MARGIN[3] - axes[1].place(v) * (HEIGHT - MARGIN[2] - MARGIN[3]);
    let mut s = String::new();
    let _ = writeln!(
        s,
        r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">
<rect width="100%" height="100%" fill="white"/>
<text x="{}" y="26" font-size="15">{}</text>"#,
        MARGIN[0],
        escape(title)
    );
    let (right, bottom) = (WIDTH - MARGIN[1], HEIGHT - MARGIN[3]);
    for t in axes[0].ticks() {
        let at = x(t);
        let _ = writeln!(
            s,
            r##"<path d="M{at:.1} {}V{bottom}" stroke="#ddd"/><text x="{at:.1}" y="{}" text-anchor="middle">{}</text>"##,
            MARGIN[2],
            bottom + 18.0,
            super::human::number(t)
        );
    }
    for t in axes[1].ticks() {
        let at = y(t);
        let _ = writeln!(
            s,
            r##"<path d="M{} {at:.1}H{right}" stroke="#ddd"/><text x="{}" y="{:.1}" text-anchor="end">{}</text>"##,
            MARGIN[0],
            MARGIN[0] - 6.0,
            at + 4.0,
            super::human::number(t)
        );
    }
    let middle = (MARGIN[2] + bottom) / 2.0;
    let _ = writeln!(
        s,
        r#"<text x="{}" y="{}" text-anchor="middle">{}</text>"#,
        (MARGIN[0] + right) / 2.0,
        HEIGHT - 14.0,
        escape(x_label)
    );
    let _ = writeln!(
        s,
        r#"<text transform="translate(18 {middle}) rotate(-90)" text-anchor="middle">{}</text>"#,
        escape(y_label)
    );
    let mut front: Vec<&Point> = points.iter().filter(|p| p.front).collect();
    front.sort_by(|a, b| a.at[0].total_cmp(&b.at[0]));
    let path: Vec<String> = front.iter().map(|p| format!("{:.1} {:.1}", x(p.at[0]), y(p.at[1]))).collect();
    if !path.is_empty() {
        let _ = writeln!(s, r##"<path d="M{}" fill="none" stroke="#888" stroke-dasharray="4 3"/>"##, path.join("L"));
    }
    let mut series: Vec<&str> = Vec::new();
    for p in points {
        let at = series.iter().position(|n| *n == p.series).unwrap_or_else(|| {
            series.push(&p.series);
            series.len() - 1
        });
        let colour = COLOURS[at % COLOURS.len()];
        let (px, py) = (x(p.at[0]), y(p.at[1]));
        let label = escape(&p.label);
        let _ =
            writeln!(s, r#"<circle cx="{px:.1}" cy="{py:.1}" r="4" fill="{colour}"><title>{label}</title></circle>"#);
        if p.front {
            let _ = writeln!(s, r#"<text x="{:.1}" y="{:.1}" font-size="10">{label}</text>"#, px + 6.0, py - 5.0);
        }
    }
    for (i, name) in series.iter().enumerate() {
        let at = MARGIN[2] + 16.0 * i as f64;
        let colour = COLOURS[i % COLOURS.len()];
        let _ = writeln!(
            s,
            r#"<circle cx="{}" cy="{at}" r="4" fill="{colour}"/><text x="{}" y="{}">{}</text>"#,
            right + 16.0,
            right + 26.0,
            at + 4.0,
            escape(name)
        );
    }
    s.push_str("</svg>\n");
    s
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_point_is_drawn_inside_the_frame() {
        let point = |label: &str, at, front| Point { label: label.into(), series: "a<b".into(), at, front };
        let points = [point("p & q", [0.1, 1e-3], true), point("r", [10.0, 0.0], false), point("s", [1.0, 0.5], true)];
        let text = svg("t", "x", "y", &points);
        assert_eq!(text.matches("<circle").count(), 4);
        assert!(text.contains("p &amp; q") && text.contains("a&lt;b") && !text.contains("NaN"));
        assert_eq!(text.matches(">0</text>").count(), 1, "an error of 0 has a tick of its own");
        assert!(svg("t", "x", "y", &[]).ends_with("</svg>\n"));
        let one = [point("o", [2.0, 2.0], true)];
        assert!(!svg("t", "x", "y", &one).contains("NaN"));
    }
}
