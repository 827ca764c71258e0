//! Boxes of voxels from and to files. The only folder that names zarrs and memmap2.

pub mod bits;
pub mod blosc;
pub mod info;
pub mod layout;
pub mod open;
pub mod os;
pub mod sink;
pub mod source;
pub mod spill;

pub use info::{Orientation, VolumeInfo};
pub use layout::{LevelLayout, Pyramid};
pub use open::{changed_by, named_files, open_inputs, said_of};
pub use sink::{Sink, SinkSpec};
pub use source::Source;
pub use spill::Spill;
