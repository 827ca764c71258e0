//! Why work is not the device's, with the numbers.

use std::cell::Cell;
use std::fmt;

use super::passes::cut;
use super::record::{Sizes, WORK};
use super::sweep::MOST_REPEATED;
use crate::grid::Shape;

/// What keeps a call from the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unfit {
    /// A step has no kernel for what it reads, or for so large a box.
    Kernel,
    /// Buffers in use at once, more than a recording may have.
    Buffers(usize),
    /// Bytes of the largest buffer of the least part, and how many it may have.
    Bytes { needed: u64, cap: u64 },
    /// The parts into which a box must be cut, the voxels that they read together, and those of the whole box.
    Repeated { parts: usize, read: usize, once: usize },
}

impl fmt::Display for Unfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kib = |bytes: u64| bytes as f64 / 1024.0;
        match *self {
            Unfit::Kernel => write!(f, "has no kernel for boxes of this size"),
            Unfit::Buffers(n) => write!(f, "takes {n} buffers at once, of which there are {WORK}"),
            Unfit::Bytes { needed, cap } => {
                write!(f, "takes a buffer of {:.1} KiB for its least part, of at most {:.1}", kib(needed), kib(cap))
            }
            Unfit::Repeated { parts, read, once } => {
                let times = read as f64 / once.max(1) as f64;
                write!(
                    f,
                    "cut into {parts} parts reads {times:.1} voxels for each of a brick, of at most {MOST_REPEATED}"
                )
            }
        }
    }
}

/// As [`cut`], into boxes that can be recorded with every buffer at most `cap` bytes.
///
/// # Errors
/// Why the least box cannot, or any for another reason than bytes.
pub fn cut_to(
    shape: Shape,
    cap: u64,
    sizes: impl Fn([usize; 3], Shape) -> Result<Sizes, Unfit>,
) -> Result<Vec<([usize; 3], Shape)>, Unfit> {
    let (large, never) = (Cell::new(None), Cell::new(None));
    let boxes = cut(shape, |lo, shape| match sizes(lo, shape) {
        Ok(sizes) if sizes.largest() <= cap => true,
        Ok(sizes) => {
            large.set(Some(Unfit::Bytes { needed: sizes.largest(), cap }));
            false
        }
        Err(why @ Unfit::Bytes { .. }) => {
            large.set(Some(why));
            false
        }
        // No smaller box mends it.
        Err(why) => {
            never.set(Some(why));
            true
        }
    });
    match never.get() {
        Some(why) => Err(why),
        None => boxes.ok_or(large.get().unwrap_or(Unfit::Kernel)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_hold_their_numbers() {
        let texts = [
            (Unfit::Buffers(40), "40 buffers"),
            (Unfit::Bytes { needed: 3 << 20, cap: 1 << 20 }, "3072.0 KiB for its least part, of at most 1024.0"),
            (Unfit::Repeated { parts: 9, read: 55, once: 10 }, "9 parts reads 5.5 voxels"),
        ];
        for (why, part) in texts {
            assert!(why.to_string().contains(part), "{why}");
        }
    }
}
