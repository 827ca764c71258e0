//! How far a run is: a bar on a terminal, a line every few seconds elsewhere.

use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use super::human;
use crate::run::Progress;

/// Between two plain lines.
const EVERY: Duration = Duration::from_secs(5);

/// Progress on stderr.
pub struct Shown {
    style: Style,
    start: Instant,
    state: Mutex<State>,
}

enum Style {
    Quiet,
    Bar(ProgressBar),
    Lines,
}

#[derive(Default)]
struct State {
    last_line: Option<Instant>,
    phase: String,
    /// When this phase began and what was done then, so that resumed bricks do not count as speed.
    phase_start: Option<(Instant, u64)>,
}

impl Shown {
    /// Chooses the form: nothing when quiet, a bar on a terminal, else lines.
    pub fn new(quiet: bool) -> Shown {
        let style = match (quiet, std::io::stderr().is_terminal()) {
            (true, _) => Style::Quiet,
            (false, true) => Style::Bar(bar()),
            (false, false) => Style::Lines,
        };
        Shown { style, start: Instant::now(), state: Mutex::default() }
    }

    /// As [`Shown::new`], of work that is mostly done in a moment: the first plain line comes after some seconds.
    pub fn patient(quiet: bool) -> Shown {
        let shown = Shown::new(quiet);
        shown.state.lock().unwrap_or_else(|e| e.into_inner()).last_line = Some(Instant::now());
        shown
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        if let Style::Bar(bar) = &self.style {
            bar.finish_and_clear();
        }
    }
}

/// Voxels counted towards a total, without bricks.
pub struct Count<'a> {
    progress: &'a dyn Progress,
    phase: &'static str,
    done: u64,
    total: u64,
}

impl<'a> Count<'a> {
    pub fn new(progress: &'a dyn Progress, phase: &'static str, total: usize) -> Count<'a> {
        Count { progress, phase, done: 0, total: total as u64 }
    }

    pub fn add(&mut self, voxels: usize) {
        self.done += voxels as u64;
        self.progress.update(self.done, self.total, 0, 0, self.phase);
    }
}

fn bar() -> ProgressBar {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr_with_hz(8));
    let template = "{prefix:10} {wide_bar} {percent:>3}%  {msg}";
    bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

/// `rate, ETA` from the voxels (unpacking: bytes) done since the phase began.
fn pace(done: u64, total: u64, seconds: f64, phase: &str) -> String {
    if done == 0 || seconds <= 0.0 {
        return "starting".into();
    }
    let rate = done as f64 / seconds;
    let eta = total.saturating_sub(done) as f64 / rate;
    let rate = match phase {
        "unpack" => format!("{}/s", human::bytes(rate as u64)),
        _ => format!("{} voxels/s", human::count(rate)),
    };
    format!("{rate}, {} left", human::seconds(eta))
}

impl Progress for Shown {
    fn update(&self, done: u64, total: u64, bricks: u64, bricks_total: u64, phase: &str) {
        if matches!(self.style, Style::Quiet) {
            return;
        }
        let now = Instant::now();
        let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
        if state.phase != phase {
            state.phase = phase.to_string();
            state.phase_start = Some((now, done));
        }
        let (since, at_start) = state.phase_start.unwrap_or((self.start, 0));
        let fresh = done.saturating_sub(at_start);
        let pace = pace(fresh, total.saturating_sub(at_start), now.duration_since(since).as_secs_f64(), phase);
        let counted = if bricks_total == 0 { String::new() } else { format!("{bricks}/{bricks_total} bricks, ") };
        match &self.style {
            Style::Quiet => {}
            Style::Bar(bar) => {
                bar.set_length(total);
                bar.set_prefix(phase.to_string());
                bar.set_message(format!("{counted}{pace}"));
                bar.set_position(done.min(total));
            }
            Style::Lines => {
                let finished = total > 0 && done >= total;
                if fresh == 0
                    || state.last_line.is_some_and(|t| now.duration_since(t) < EVERY)
                    || (finished && state.last_line.is_none())
                {
                    return;
                }
                state.last_line = Some(now);
                let percent = if total == 0 { 100.0 } else { 100.0 * done as f64 / total as f64 };
                let _ = writeln!(std::io::stderr(), "{phase}: {percent:.1} %, {counted}{pace}");
            }
        }
    }

    fn note(&self, text: &str) {
        match &self.style {
            Style::Quiet => {}
            Style::Bar(bar) => bar.suspend(|| {
                let _ = writeln!(std::io::stderr(), "{text}");
            }),
            Style::Lines => {
                let _ = writeln!(std::io::stderr(), "{text}");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn pace_counts_what_is_left() {
        assert_eq!(super::pace(0, 10, 1.0, "compute"), "starting");
        assert_eq!(super::pace(2_000_000, 10_000_000, 1.0, "compute"), "2.00 M voxels/s, 4.0 s left");
        assert_eq!(super::pace(20, 10, 1.0, "compute"), "20 voxels/s, 0 ms left");
        assert_eq!(super::pace(3 << 20, 6 << 20, 1.0, "unpack"), "3.00 MiB/s, 1.0 s left");
    }
}
