//! Maximum errors of the elementary functions over their whole domain.

use occlude::kernel::simd::Level;
use occlude::kernel::window::{math, power_row, reference};

/// Name, domain, largest absolute and largest relative error, and where the absolute one lies.
pub struct Error {
    pub name: &'static str,
    pub domain: &'static str,
    pub absolute: f64,
    pub relative: f64,
    pub at: String,
}

/// The normal distribution function through erf by paper A's formula (Winitzki), in f64: what is left is the formula.
pub fn phi_of_paper(z: f64) -> f64 {
    let a = 8.0 * (std::f64::consts::PI - 3.0) / (3.0 * std::f64::consts::PI * (4.0 - std::f64::consts::PI));
    let x2 = z * z / 2.0;
    let erf = (1.0 - (-x2 * (4.0 / std::f64::consts::PI + a * x2) / (1.0 + a * x2)).exp()).sqrt();
    0.5 * (1.0 + erf.copysign(z))
}

struct Worst(Error);

impl Worst {
    fn new(name: &'static str, domain: &'static str) -> Worst {
        Worst(Error { name, domain, absolute: 0.0, relative: 0.0, at: String::new() })
    }

    fn add(&mut self, value: f64, exact: f64, at: impl Fn() -> String) {
        let error = (value - exact).abs();
        // What rounds to zero in f32 has no relative error worth a word.
        if exact > 1e-30 {
            self.0.relative = self.0.relative.max(error / exact);
        }
        if error > self.0.absolute || error.is_nan() {
            (self.0.absolute, self.0.at) = (error, at());
        }
    }
}

/// Every function: ours and what it stands beside.
pub fn all() -> Vec<Error> {
    let domain = "z in [-40, 40]";
    let mut paper = Worst::new("Phi through erf of paper A, f64", domain);
    let mut ours = Worst::new("Phi, ours, f32", domain);
    for i in -400_000..=400_000 {
        let z = (i as f64 * 1e-4) as f32;
        let exact = reference::normal(z as f64);
        paper.add(phi_of_paper(z as f64), exact, || format!("z = {z}"));
        ours.add(math::phi(z) as f64, exact, || format!("z = {z}"));
    }
    let domain = "t in (0, 1), beta in [1e-6, 1e6]";
    let mut library = Worst::new("t^beta, powf of t and beta in f32", domain);
    let mut power = Worst::new("t^beta, ours, f32", domain);
    for range in [255u32, 65_535, 16_777_215] {
        let step = (range / 6000).max(1);
        for a in (1..range).step_by(step as usize).chain(range - 200..range) {
            let b = range - a;
            let t = a as f64 / range as f64;
            let log = if b < a { (-(b as f64) / range as f64).ln_1p() } else { t.ln() };
            // Windows of one voxel's weight whose sum has the beta of its place in the row.
            let betas: [f32; 121] = std::array::from_fn(|j| 10f32.powf((j as f32 - 60.0) * 0.1));
            let sums = betas.map(|beta| range as f64 * (beta as f64 / (1.0 + beta as f64)));
            let [v, lo, hi] = [a, 0, range].map(|v| [v as f32; 121]);
            let mut powers = [f32::NAN; 121];
            power_row(Level::detect(), [&v, &lo, &hi], &sums, &[1.0; 121], &mut powers);
            for (beta, p) in betas.into_iter().zip(powers) {
                let exact = (beta as f64 * log).exp();
                let at = || format!("t = {a}/{range}, beta = {beta}");
                library.add((a as f32 / range as f32).powf(beta) as f64, exact, at);
                power.add(p as f64, exact, at);
            }
        }
    }
    [paper, ours, library, power].map(|w| w.0).into()
}
