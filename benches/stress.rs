//! Prints the table of worst cases of the numerical stress suite as Markdown.
//!
//! `cargo bench --bench stress [-- MACHINE AND DATE] > benches/results/stress.md`

#[path = "../tests/stress_fields/mod.rs"]
mod stress_fields;

use stress_fields::{counted, fields, functions, measure, measure_gaussian};

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    println!("# Numerical stress suite: worst cases\n");
    if !words.is_empty() {
        println!("Measured on: {}.\n", words.join(" "));
    }
    println!(
        "Made by `cargo bench --bench stress`; `tests/stress.rs` asserts the bounds on the same fields. References: i128 for\n\
         integers, two passes of double-double arithmetic for floats. *ulps* are units in the last place of the result (f32,\n\
         f64 for u32, i32 and f64 inputs), 0 being the exact value rounded once; openness errors are absolute. *naive*: running f32 sums of v and v^2 along each\n\
         axis and E\\[v^2\\] - E\\[v\\]^2, relative error; *lost* counts sampled voxels that became NaN or infinite and should not.\n"
    );
    windows();
    counts();
    gaussians();
    println!("## Elementary functions\n");
    println!("| function | domain | max absolute error | at | max relative error |\n|---|---|---|---|---|");
    for e in functions::all() {
        println!("| {} | {} | {} | {} | {} |", e.name, e.domain, short(e.absolute), e.at, short(e.relative));
    }
    println!("\nRelative errors count where the exact value is above 1e-30.");
}

fn windows() {
    println!("## Box windows\n");
    println!(
        "| field | type | radius | mean, ulps | variance, ulps | variance, relative | std, ulps | moment2, ulps | \
         cdf_power | gaussian_cdf | chebyshev | beta | naive mean | naive variance | naive lost |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    for field in fields::all() {
        let w = measure(&field);
        let r = field.radius;
        let radius =
            if r[0] == r[1] && r[1] == r[2] { r[0].to_string() } else { format!("{}, {}, {}", r[0], r[1], r[2]) };
        let cells = [w.ulps[0], w.ulps[1], w.relative[1], w.ulps[2], w.ulps[3]].into_iter().chain(w.openness);
        let cells: Vec<String> = cells.chain(w.naive).map(short).collect();
        println!(
            "| {} | {} | {radius} | {} | {} of {} |",
            field.name,
            field.dtype,
            cells.join(" | "),
            w.naive_lost,
            w.samples
        );
    }
    println!();
}

fn counts() {
    println!("## Counts\n");
    println!(
        "`levels` (32): largest difference from its formula. `moments4`: sampled voxels whose exact count lies outside the bounds\n\
         (guaranteed: none), mean width of the bounds, RMSE of their middle. Ties `mid`.\n"
    );
    println!("| field | type | levels | moments4 outside | width | middle |\n|---|---|---|---|---|---|");
    for field in fields::all() {
        let c = counted::measure(&field);
        println!(
            "| {} | {} | {} | {} of {} | {} | {} |",
            field.name,
            field.dtype,
            short(c.levels),
            c.outside,
            c.samples,
            short(c.width),
            short(c.middle)
        );
    }
    println!();
}

fn gaussians() {
    println!("## Truncated Gaussian, sigma 1.5\n");
    println!(
        "Mean: error beyond 3 ulps (three passes, which round) as a share of the window's range. Variance: relative where |mean|/std <= 1e6.\n"
    );
    println!("| field | type | mean | variance |\n|---|---|---|---|");
    for field in fields::all() {
        let [mean, variance] = measure_gaussian(&field, 1.5);
        println!("| {} | {} | {} | {} |", field.name, field.dtype, short(mean), short(variance));
    }
    println!();
}

fn short(v: f64) -> String {
    match v {
        0.0 => "0".into(),
        v if v.is_infinite() => "infinite".into(),
        v if (0.01..1000.0).contains(&v) => format!("{v:.3}"),
        v => format!("{v:.1e}"),
    }
}
