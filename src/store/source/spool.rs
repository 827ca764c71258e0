//! Packed inputs, unpacked once into a scratch file that has no name: nothing is left behind, even after a kill.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use bzip2::bufread::MultiBzDecoder;
use flate2::bufread::{MultiGzDecoder, ZlibDecoder};

use super::bytes;
use crate::store::os;
use crate::{Error, Result};

/// How a stream of voxels is packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packing {
    Gzip,
    Zlib,
    Bzip2,
}

/// A packed stream that holds the voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct Packed {
    pub path: PathBuf,
    pub packing: Packing,
    /// Bytes of the file before the packed stream.
    pub start: u64,
    /// Bytes of the unpacked stream before the voxels.
    pub skip: u64,
    /// Bytes of voxels after them.
    pub len: u64,
    pub after: After,
}

/// What becomes of unpacked bytes after the voxels. The stream's checksum is verified but with `Ignored`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum After {
    Refused,
    /// Allowed, as other readers of the format do.
    Allowed,
    /// Not even looked at, nor what may follow the stream.
    Ignored,
}

/// Told the bytes done; `false` stops.
pub type Progress<'a> = &'a dyn Fn(u64) -> bool;

const BLOCK: usize = 1 << 20;

impl Packing {
    pub fn name(self) -> &'static str {
        match self {
            Packing::Gzip => "gzip",
            Packing::Zlib => "zlib",
            Packing::Bzip2 => "bzip2",
        }
    }

    /// Unpacks bytes in memory that should expand to `want` bytes, and no more than a byte beyond that.
    pub fn unpack(self, packed: &[u8], want: u64) -> Result<Vec<u8>, String> {
        let mut out = Vec::new();
        let read = match self {
            Packing::Gzip => MultiGzDecoder::new(packed).take(want + 1).read_to_end(&mut out),
            Packing::Zlib => ZlibDecoder::new(packed).take(want + 1).read_to_end(&mut out),
            Packing::Bzip2 => MultiBzDecoder::new(packed).take(want + 1).read_to_end(&mut out),
        };
        read.map_err(|e| format!("the {} data are broken: {e}", self.name()))?;
        if out.len() as u64 > want {
            return Err(format!("the {} data expand to more than the {want} bytes that the metadata say", self.name()));
        }
        Ok(out)
    }
}

impl Packed {
    /// A reader of the unpacked stream from its start.
    pub fn reader(&self) -> Result<Box<dyn Read>> {
        let mut file = bytes::open_file(&self.path)?;
        file.seek(SeekFrom::Start(self.start)).map_err(|e| Error::file(&self.path, e))?;
        let file = BufReader::with_capacity(1 << 18, file);
        Ok(match self.packing {
            Packing::Gzip => Box::new(MultiGzDecoder::new(file)),
            Packing::Zlib => Box::new(ZlibDecoder::new(file)),
            Packing::Bzip2 => Box::new(MultiBzDecoder::new(file)),
        })
    }

    /// Unpacks the voxels into a nameless file in `scratch`.
    pub fn unpack(&self, scratch: &Path, progress: Progress) -> Result<File> {
        let mut out = nameless(scratch, self.len)?;
        let mut reader = self.reader()?;
        let mut block = vec![0u8; BLOCK];
        let skipped = self.copy(&mut *reader, None, self.skip, &mut block, &|_| true)?;
        if skipped < self.skip {
            return Err(self.wrong_len(skipped.to_string()));
        }
        let done = self.copy(&mut *reader, Some((&mut out, scratch)), self.len, &mut block, progress)?;
        if done < self.len {
            return Err(self.wrong_len((self.skip + done).to_string()));
        }
        if self.after != After::Ignored {
            // Read to the end: this also verifies the stream's checksum. A few blocks more are counted, a bomb is not.
            let more = self.copy(&mut *reader, None, 64 * BLOCK as u64, &mut block, &|_| true)?;
            if more > 0 && self.after == After::Refused {
                let total = self.skip + done + more;
                let most = more == 64 * BLOCK as u64;
                return Err(self.wrong_len(format!("{}{total}", if most { "at least " } else { "" })));
            }
        }
        Ok(out)
    }

    /// Copies up to `most` bytes into `out`, or nowhere; returns how many there were.
    fn copy(
        &self,
        reader: &mut dyn Read,
        mut out: Option<(&mut File, &Path)>,
        most: u64,
        block: &mut [u8],
        progress: Progress,
    ) -> Result<u64> {
        let mut done = 0u64;
        while done < most {
            let want = block.len().min((most - done) as usize);
            let got = match reader.read(&mut block[..want]) {
                Ok(0) => break,
                Ok(n) => n,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
                // A cut-off stream: what came before it is the useful number.
                Err(e) => {
                    let at = self.skip + done;
                    let text =
                        format!("the {} data are broken or cut off after about {at} bytes: {e}", self.packing.name());
                    return Err(Error::file(&self.path, text));
                }
            };
            if let Some((file, folder)) = &mut out {
                file.write_all(&block[..got]).map_err(|e| Error::file(*folder, format!("scratch: {e}")))?;
            }
            done += got as u64;
            if !progress(done) {
                return Err(Error::Interrupted);
            }
        }
        Ok(done)
    }

    fn wrong_len(&self, found: String) -> Error {
        let want = self.skip + self.len;
        Error::file(
            &self.path,
            format!(
                "the {} data expand to {found} bytes, but the header says {want} (raw: shape, dtype, offset; bytes that follow are \
                 allowed with trailing = \"ignore\")",
                self.packing.name()
            ),
        )
    }
}

/// A file without a name in `scratch`, after a check that `len` bytes have room there.
pub fn nameless(scratch: &Path, len: u64) -> Result<File> {
    if let Some(free) = os::free_bytes(scratch).filter(|free| *free < len) {
        return Err(Error::file(
            scratch,
            format!(
                "the scratch folder has room for {free} bytes, but unpacking the input needs {len} ({} more); \
                 set run.scratch to a folder on a larger disk",
                len - free
            ),
        ));
    }
    let failed = |e: std::io::Error| Error::file(scratch, format!("scratch file: {e}"));
    for attempt in 0..1000u32 {
        let path = scratch.join(format!(".occlude-spool-{}-{attempt}", std::process::id()));
        match File::options().read(true).write(true).create_new(true).open(&path) {
            Ok(file) => {
                std::fs::remove_file(&path).map_err(failed)?;
                return Ok(file);
            }
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => continue,
            Err(e) => return Err(failed(e)),
        }
    }
    Err(Error::file(scratch, "no free name for a scratch file"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_without_room_is_named_with_what_is_missing() {
        let folder = tempfile::tempdir().unwrap();
        let text = nameless(folder.path(), 1 << 60).unwrap_err().to_string();
        assert!(text.contains("needs 1152921504606846976") && text.contains("more); set run.scratch"), "{text}");
        nameless(folder.path(), 1).unwrap().write_all(b"x").unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn unpacking_in_memory_is_bounded() {
        let mut writer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        writer.write_all(&[7; 1000]).unwrap();
        let packed = writer.finish().unwrap();
        assert_eq!(Packing::Gzip.unpack(&packed, 1000).unwrap(), [7; 1000]);
        assert!(Packing::Gzip.unpack(&packed, 999).unwrap_err().contains("999"));
        assert!(Packing::Zlib.unpack(&packed, 1000).is_err());
        assert!(Packing::Gzip.unpack(&packed[..packed.len() / 2], 1000).is_err());
    }
}
