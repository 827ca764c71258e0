//! `occlude` streams volumes larger than memory through a graph of local filters and writes mip-mapped pyramids of
//! ambient occlusion, obscurance, variance and moments.
//!
//! The folders, from the bottom up (each uses only those before it, and all may ask [`kernel::simd`] for the instruction set):
//!
//! | folder | what it holds |
//! |---|---|
//! | [`grid`] | boxes, shapes, element types, borrowed views |
//! | [`brick`] | voxels in memory: buffers, pool, scratch, halo assembly |
//! | [`stage`] | what each stage is: prepared parameters; touches no voxel |
//! | [`kernel`] | voxels to voxels on the CPU; each fast kernel beside its reference |
//! | [`config`] | TOML text to typed configuration |
//! | [`store`] | boxes of voxels from and to files |
//! | [`gpu`] | most stages on a GPU, and what the planner knows of them |
//! | [`plan`] | graph to plan: lattices, halos, fusing, bricks, tasks, peak bytes |
//! | [`run`] | executes a plan: readers, workers, writers, byte budget, journal |
//! | [`cli`] | commands, messages, reports |
//!
//! Words: a *brick* is the unit of work, its *halo* the margin of input; *chunks* and *shards* are units of Zarr
//! storage; a *stage* is a node of the graph, a *channel* one of its named results; a *task* is the unit of completion.

pub mod brick;
pub mod cli;
pub mod config;
pub mod error;
pub mod gpu;
pub mod grid;
pub mod kernel;
pub mod plan;
pub mod run;
pub mod stage;
pub mod store;

pub use error::{Error, Result};
