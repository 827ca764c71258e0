//! What a run counts while it runs.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use crate::kernel::obscurance::LineCounts;
use crate::store::os;

/// Counters that all threads add to.
#[derive(Debug)]
pub struct Metrics {
    start: Instant,
    bytes_read: AtomicU64,
    bytes_written: AtomicU64,
    voxels_gathered: AtomicU64,
    bricks_done: AtomicU64,
    voxels_done: AtomicU64,
    bricks_computed: AtomicU64,
    bricks_resumed: AtomicU64,
    voxels_resumed: AtomicU64,
    skipped: Mutex<BTreeMap<&'static str, u64>>,
    waits: Mutex<BTreeMap<&'static str, f64>>,
    steps: Vec<StepCounters>,
    /// Lines of sweeps per step: all, those without a needed voxel, those that nothing can occlude.
    lines: Vec<[AtomicU64; 3]>,
    /// Bricks per step that the GPU left to the CPU.
    shared: Vec<AtomicU64>,
    /// Per flow of several steps.
    flows: Vec<FlowCounters>,
    /// Nanoseconds of reading, converting with levels, and encoding.
    pub read_ns: AtomicU64,
    pub encode_ns: AtomicU64,
    peak: AtomicU64,
}

#[derive(Debug, Default)]
struct StepCounters {
    ns: AtomicU64,
    /// Of those, with a core.
    core_ns: AtomicU64,
    voxels: AtomicU64,
}

/// What a step did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepTotals {
    /// Summed over threads.
    pub seconds: f64,
    /// Of those, with a core: what others on the machine take does not count.
    pub core_seconds: f64,
    pub voxels: u64,
}

/// Since when a thread has been at something, by the clock and by the time that it has had a core.
#[derive(Debug, Clone, Copy)]
pub struct Since {
    pub clock: Instant,
    core: Option<Duration>,
}

impl Since {
    pub fn now() -> Since {
        Since { clock: Instant::now(), core: os::thread_time() }
    }

    /// Seconds with a core; by the clock where the system does not say.
    fn core_time(&self) -> Duration {
        let taken = self.core.and_then(|from| os::thread_time()?.checked_sub(from));
        taken.unwrap_or_else(|| self.clock.elapsed())
    }
}

#[derive(Debug, Default)]
struct FlowCounters {
    ns: AtomicU64,
    voxels: AtomicU64,
    bricks: AtomicU64,
    left: AtomicU64,
}

/// What steps did that ran on the GPU in one go.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FlowTotals {
    /// Summed over threads.
    pub seconds: f64,
    /// Voxels of the bricks.
    pub voxels: u64,
    pub bricks: u64,
    /// Bricks that the device left, whose steps ran one by one.
    pub left: u64,
}

impl Metrics {
    pub fn new(steps: usize, flows: usize) -> Metrics {
        Metrics {
            start: Instant::now(),
            bytes_read: AtomicU64::default(),
            bytes_written: AtomicU64::default(),
            voxels_gathered: AtomicU64::default(),
            bricks_done: AtomicU64::default(),
            voxels_done: AtomicU64::default(),
            bricks_computed: AtomicU64::default(),
            bricks_resumed: AtomicU64::default(),
            voxels_resumed: AtomicU64::default(),
            skipped: Mutex::default(),
            waits: Mutex::default(),
            steps: (0..steps).map(|_| Default::default()).collect(),
            lines: (0..steps).map(|_| Default::default()).collect(),
            shared: (0..steps).map(|_| Default::default()).collect(),
            flows: (0..flows).map(|_| Default::default()).collect(),
            read_ns: AtomicU64::default(),
            encode_ns: AtomicU64::default(),
            peak: AtomicU64::default(),
        }
    }

    pub fn seconds(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    pub fn bytes_read(&self, n: u64) {
        self.bytes_read.fetch_add(n, Relaxed);
    }

    pub fn bytes_written(&self, n: u64) {
        self.bytes_written.fetch_add(n, Relaxed);
    }

    pub fn gathered(&self, voxels: u64) {
        self.voxels_gathered.fetch_add(voxels, Relaxed);
    }

    pub fn brick_done(&self, voxels: u64) {
        self.bricks_done.fetch_add(1, Relaxed);
        self.voxels_done.fetch_add(voxels, Relaxed);
    }

    pub fn computed(&self) {
        self.bricks_computed.fetch_add(1, Relaxed);
    }

    pub fn resumed(&self, bricks: u64, voxels: u64) {
        self.bricks_resumed.fetch_add(bricks, Relaxed);
        self.voxels_resumed.fetch_add(voxels, Relaxed);
        self.bricks_done.fetch_add(bricks, Relaxed);
        self.voxels_done.fetch_add(voxels, Relaxed);
    }

    pub fn skipped(&self, cause: &'static str) {
        *self.skipped.lock().unwrap_or_else(|e| e.into_inner()).entry(cause).or_default() += 1;
    }

    pub fn waited(&self, cause: &'static str, seconds: f64) {
        *self.waits.lock().unwrap_or_else(|e| e.into_inner()).entry(cause).or_default() += seconds;
    }

    pub fn step(&self, step: usize, since: Since, voxels: u64) {
        let to = &self.steps[step];
        to.ns.fetch_add(since.clock.elapsed().as_nanos() as u64, Relaxed);
        to.core_ns.fetch_add(since.core_time().as_nanos() as u64, Relaxed);
        to.voxels.fetch_add(voxels, Relaxed);
    }

    /// A step made voxels as part of a flow, which has the time.
    pub fn step_in_flow(&self, step: usize, voxels: u64) {
        self.steps[step].voxels.fetch_add(voxels, Relaxed);
    }

    /// A flow made a brick.
    pub fn flow(&self, flow: usize, start: Instant, voxels: u64) {
        let to = &self.flows[flow];
        to.ns.fetch_add(start.elapsed().as_nanos() as u64, Relaxed);
        to.voxels.fetch_add(voxels, Relaxed);
        to.bricks.fetch_add(1, Relaxed);
    }

    /// The device left a brick of a flow.
    pub fn flow_left(&self, flow: usize) {
        self.flows[flow].left.fetch_add(1, Relaxed);
    }

    pub fn flow_totals(&self, flow: usize) -> FlowTotals {
        let [ns, voxels, bricks, left] = {
            let FlowCounters { ns, voxels, bricks, left } = &self.flows[flow];
            [ns, voxels, bricks, left].map(|n| n.load(Relaxed))
        };
        FlowTotals { seconds: ns as f64 * 1e-9, voxels, bricks, left }
    }

    /// A sweep of a step looked at these lines.
    pub fn lines(&self, step: usize, counts: LineCounts) {
        let [total, masked, open] = &self.lines[step];
        total.fetch_add(counts.total, Relaxed);
        masked.fetch_add(counts.masked, Relaxed);
        open.fetch_add(counts.open, Relaxed);
    }

    /// Lines of a step by what became of them; empty if it swept none.
    pub fn line_counts(&self, step: usize) -> BTreeMap<String, u64> {
        let counts = ["total", "where", "open"].into_iter().zip(&self.lines[step]);
        let counts: BTreeMap<_, _> = counts.map(|(name, n)| (name.to_string(), n.load(Relaxed))).collect();
        if counts["total"] > 0 { counts } else { BTreeMap::new() }
    }

    /// A CPU worker took a brick of a step on the GPU.
    pub fn shared(&self, step: usize) {
        self.shared[step].fetch_add(1, Relaxed);
    }

    pub fn shared_bricks(&self, step: usize) -> u64 {
        self.shared[step].load(Relaxed)
    }

    /// Seconds in a step's kernels (summed over threads) and voxels that it made, halos included.
    pub fn step_totals(&self, step: usize) -> StepTotals {
        let StepCounters { ns, core_ns, voxels } = &self.steps[step];
        let [ns, core_ns, voxels] = [ns, core_ns, voxels].map(|n| n.load(Relaxed));
        StepTotals { seconds: ns as f64 * 1e-9, core_seconds: core_ns as f64 * 1e-9, voxels }
    }

    /// Takes in what a pre-pass counted, except its bricks.
    pub fn absorb(&self, other: &Metrics) {
        self.bytes_read(other.bytes_read.load(Relaxed));
        self.gathered(other.voxels_gathered.load(Relaxed));
        self.read_ns.fetch_add(other.read_ns.load(Relaxed), Relaxed);
        self.peak.fetch_max(other.peak.load(Relaxed), Relaxed);
        for (mine, theirs) in self.steps.iter().zip(&other.steps) {
            mine.ns.fetch_add(theirs.ns.load(Relaxed), Relaxed);
            mine.core_ns.fetch_add(theirs.core_ns.load(Relaxed), Relaxed);
            mine.voxels.fetch_add(theirs.voxels.load(Relaxed), Relaxed);
        }
    }

    /// Bricks and voxels done.
    pub fn done(&self) -> (u64, u64) {
        (self.bricks_done.load(Relaxed), self.voxels_done.load(Relaxed))
    }

    /// Private resident bytes now; remembers the most.
    pub fn sample_memory(&self) {
        if let Some(bytes) = os::private_bytes() {
            self.peak.fetch_max(bytes, Relaxed);
        }
    }

    /// The counted part of a report.
    pub fn fill(&self, report: &mut super::Report, region_voxels: u64) {
        report.seconds = self.seconds();
        report.voxels = region_voxels;
        // What an earlier run did took none of this one's time.
        let made = region_voxels.saturating_sub(self.voxels_resumed.load(Relaxed));
        report.voxels_per_second = made as f64 / report.seconds.max(1e-9);
        report.bricks.computed = self.bricks_computed.load(Relaxed);
        report.bricks.resumed = self.bricks_resumed.load(Relaxed);
        let skipped = self.skipped.lock().unwrap_or_else(|e| e.into_inner());
        report.bricks.skipped = skipped.iter().map(|(k, v)| (k.to_string(), *v)).collect();
        report.bytes_read = self.bytes_read.load(Relaxed);
        report.bytes_written = self.bytes_written.load(Relaxed);
        report.peak_memory_bytes = self.peak.load(Relaxed);
        let own = self.voxels_done.load(Relaxed).saturating_sub(self.voxels_resumed.load(Relaxed)).max(1);
        report.read_amplification = self.voxels_gathered.load(Relaxed) as f64 / own as f64;
        let waits = self.waits.lock().unwrap_or_else(|e| e.into_inner());
        report.waits = waits.iter().map(|(k, v)| (k.to_string(), *v)).collect();
        report.waits.insert("read_busy".into(), self.read_ns.load(Relaxed) as f64 * 1e-9);
        report.waits.insert("encode_busy".into(), self.encode_ns.load(Relaxed) as f64 * 1e-9);
    }
}
