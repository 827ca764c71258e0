//! CPU and GPU agree (SPEC 5.6). What is made of sums, extremes and contributions in exact integers must equal the CPU's
//! **bit for bit**, since the CPU's own row functions finish them; floats must lie within `facts::tolerance`.
//!
//! They run on software Vulkan, on a GPU with OCCLUDE_TEST_GPU=hardware. Without an adapter these tests pass and are listed when all have run, unless OCCLUDE_REQUIRE_GPU_TESTS=1.

#[path = "../common/mod.rs"]
mod common;
mod fits;
mod float_windows;
mod flow_runs;
mod flows;
mod gaussian;
mod gradient;
mod levels;
mod maps;
mod masks;
mod obscurance;
mod runs;
mod setup;
mod windows;

use std::sync::Mutex;

use occlude::brick::Voxels;
use occlude::gpu::{Gpu, GpuKind};
use occlude::grid::{DType, Shape, Voxel};
use occlude::with_voxels;

use common::hash;

/// Tests that did not run, and why.
static SKIPPED: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Prints past the capture of the test harness, when the last test has run.
extern "C" fn list_skipped() {
    let skipped = SKIPPED.lock().unwrap_or_else(|e| e.into_inner());
    let text =
        format!("\nSKIPPED for want of a Vulkan adapter ({} tests):\n  {}\n", skipped.len(), skipped.join("\n  "));
    // SAFETY: the buffer is alive and as long as said.
    unsafe { libc::write(2, text.as_ptr().cast(), text.len()) };
}

/// The software adapter, or with OCCLUDE_TEST_GPU=hardware a GPU.
fn kind() -> GpuKind {
    match std::env::var("OCCLUDE_TEST_GPU").as_deref() {
        Ok("hardware") => GpuKind::Hardware,
        Ok(other) => panic!("OCCLUDE_TEST_GPU is {other:?}: \"hardware\" is known"),
        Err(_) => GpuKind::Software,
    }
}

/// The adapter to test; without one the test is noted as skipped.
fn adapter() -> Option<Gpu> {
    match Gpu::open(kind()) {
        Ok(gpu) => Some(gpu),
        Err(why) => {
            assert!(why.starts_with("looked for"), "there is an adapter, but: {why}");
            assert!(std::env::var("OCCLUDE_REQUIRE_GPU_TESTS").as_deref() != Ok("1"), "GPU tests are required: {why}");
            let mut skipped = SKIPPED.lock().unwrap_or_else(|e| e.into_inner());
            if skipped.is_empty() {
                // SAFETY: a function without state of its own, which stays valid until the process ends.
                unsafe { libc::atexit(list_skipped) };
            }
            skipped.push(format!("{}: {why}", std::thread::current().name().unwrap_or("a test")));
            None
        }
    }
}

/// A value for each index.
type Fill = Box<dyn Fn(usize) -> f64>;

/// Fills that break careless sums: noise, extremes of the type, constants, one voxel off, and a step.
fn fills(dtype: DType, shape: Shape) -> Vec<(&'static str, Voxels)> {
    fn set<T: Voxel>(v: &mut [T], value: impl Fn(usize) -> f64) {
        v.iter_mut().enumerate().for_each(|(i, v)| *v = T::from_f64(value(i)));
    }
    let (lo, hi) = dtype.range();
    let len: usize = shape.iter().product();
    let noise = move |i: usize| lo + (hash(3, i as u64) % (hi - lo + 1.0) as u64) as f64;
    let specials = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -0.0, 0.0, 1e-40, 3.5, f64::NAN];
    let mut kinds: Vec<(&'static str, Fill)> = vec![
        ("noise", Box::new(noise)),
        ("extremes", Box::new(move |i| if hash(5, i as u64).is_multiple_of(3) { lo } else { hi })),
        ("greatest", Box::new(move |_| hi)),
        ("least", Box::new(move |_| lo)),
        ("one off", Box::new(move |i| if i == len / 2 { hi - 1.0 } else { hi })),
        ("step", Box::new(move |i| if i % shape[2] < shape[2] / 2 { lo + (i % 3) as f64 } else { hi })),
    ];
    if dtype.is_float() {
        let special =
            move |i: usize| if hash(7, i as u64).is_multiple_of(2) { (i % 11) as f64 } else { specials[i % 8] };
        kinds.push(("specials", Box::new(special)));
        kinds.push(("gone", Box::new(|_| f64::NAN)));
        kinds.retain(|(name, _)| *name != "noise");
        kinds.insert(0, ("noise", Box::new(|i| hash(3, i as u64) as f64 * 1e-19 - 0.5)));
    }
    let make = |value: &dyn Fn(usize) -> f64| {
        let mut out = Voxels::zeroed(dtype, len);
        with_voxels!(&mut out, v => set(v, value));
        out
    };
    kinds.iter().map(|(name, f)| (*name, make(f))).collect()
}
