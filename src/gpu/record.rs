//! What the device does with one part of a brick, as data: buffers, dispatches and what comes back. Recording asks for no
//! device, so that tests can look at it without one.

pub use super::shaders::Shader;

/// Most bytes of parameters of a dispatch, which every adapter binds.
pub const MOST_PARAMS: u64 = 1024;
/// Most time stamps of a part, and room for them behind the results.
pub const STAMPS: usize = 256;
pub const STAMP_BYTES: u64 = 8 * STAMPS as u64;
/// Threads of a workgroup; in every shader.
pub const GROUP: u32 = 64;

/// Buffers that a recording may work in at once.
pub const WORK: usize = 32;

/// Device buffers of a slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Buffer {
    /// Packed voxels, written by the host.
    Source,
    /// Tables, written by the host.
    Tables,
    /// What dispatches write, by number.
    Work(u8),
}

/// A buffer from a place on, which is a multiple of 256 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bind {
    pub buffer: Buffer,
    pub from: u64,
}

impl From<Buffer> for Bind {
    fn from(buffer: Buffer) -> Bind {
        Bind { buffer, from: 0 }
    }
}

/// One dispatch.
#[derive(Debug, Clone, PartialEq)]
pub struct Dispatch {
    pub shader: Shader,
    /// Index into [`Shader::entries`].
    pub entry: usize,
    /// What of a shader with [`Shader::has_parts`] is compiled; else 0.
    pub parts: u32,
    /// The shader's uniform struct.
    pub params: Vec<u8>,
    /// [`Shader::bindings`] of them.
    pub bind: Vec<Bind>,
    pub threads: u32,
}

/// Bytes that come back, from a place in a buffer to a place of the results.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Readback {
    pub from: Bind,
    pub bytes: u64,
    pub to: u64,
}

/// A step of the device's work.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    Dispatch(Dispatch),
    /// Zeros in so many first bytes of a buffer.
    Clear(Buffer, u64),
    Readback(Readback),
}

/// Bytes of a flag.
pub const FLAG_BYTES: u64 = 256;

/// All that the device does with one part.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Recording {
    pub sizes: Sizes,
    /// For [`Buffer::Tables`].
    pub tables: Vec<u32>,
    pub commands: Vec<Command>,
}

impl Recording {
    pub fn dispatches(&self) -> impl Iterator<Item = &Dispatch> {
        self.commands.iter().filter_map(|c| match c {
            Command::Dispatch(d) => Some(d),
            _ => None,
        })
    }

    /// Where the parameters of each dispatch stand in their buffer, from multiples of 256 bytes on.
    pub fn params(&self) -> impl Iterator<Item = std::ops::Range<u64>> {
        let mut end = 0;
        self.dispatches().map(move |d| {
            let start = end;
            end += rounded(d.params.len() as u64);
            start..start + d.params.len() as u64
        })
    }

    /// What is wrong with it, if anything: bindings that a shader lacks or that alias, copies beyond a buffer's end.
    pub fn fault(&self) -> Option<String> {
        if self.params().last().map_or(0, |p| p.end) > self.sizes.params {
            return Some("too little room for parameters".into());
        }
        if self.tables.len() as u64 * 4 > self.sizes.tables {
            return Some("too little room for tables".into());
        }
        self.commands.iter().find_map(|command| match command {
            Command::Dispatch(d) => self.dispatch_fault(d),
            Command::Clear(b, bytes) => {
                let wrong = self.sizes.of(*b) < *bytes || bytes % 4 != 0;
                wrong.then(|| format!("{bytes} bytes of {b:?} are cleared"))
            }
            Command::Readback(r) => {
                let wrong = r.from.from + r.bytes > self.sizes.of(r.from.buffer)
                    || r.to + r.bytes > self.sizes.read
                    || r.to % 256 != 0
                    || r.bytes % 4 != 0
                    || r.from.from % 4 != 0;
                wrong.then(|| format!("{r:?} of {:?}", self.sizes))
            }
        })
    }

    fn dispatch_fault(&self, d: &Dispatch) -> Option<String> {
        // What is written may be bound once.
        let written = || d.bind.iter().zip(1..).filter(|(_, k)| d.shader.writes(*k)).map(|(b, _)| b);
        let twice = written().any(|w| d.bind.iter().filter(|b| b.buffer == w.buffer).count() > 1);
        if d.bind.len() != d.shader.bindings() || d.entry >= d.shader.entries().len() || twice {
            return Some(format!("{}: bindings {:?}, entry {}", d.shader.name(), d.bind, d.entry));
        }
        if d.params.len() as u64 > MOST_PARAMS || d.threads == 0 {
            return Some(format!("{}: {} threads", d.shader.name(), d.threads));
        }
        if d.bind.iter().any(|b| b.from % 256 != 0 || b.from >= self.sizes.of(b.buffer)) {
            return Some(format!("{}: {:?} of {:?}", d.shader.name(), d.bind, self.sizes));
        }
        let host = written().any(|b| matches!(b.buffer, Buffer::Source | Buffer::Tables));
        host.then(|| format!("{} writes what the host wrote", d.shader.name()))
    }
}

/// Bytes of the buffers of a slot, all multiples of 256.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Sizes {
    pub params: u64,
    pub tables: u64,
    pub source: u64,
    pub work: [u64; WORK],
    /// Everything that comes back.
    pub read: u64,
}

/// Buffers that serve bricks which differ by a few voxels, and copies that are aligned.
pub fn rounded(bytes: u64) -> u64 {
    bytes.next_multiple_of(256).max(256)
}

impl Sizes {
    pub fn max(self, o: Sizes) -> Sizes {
        Sizes {
            params: self.params.max(o.params),
            tables: self.tables.max(o.tables),
            source: self.source.max(o.source),
            work: std::array::from_fn(|i| self.work[i].max(o.work[i])),
            read: self.read.max(o.read),
        }
    }

    pub fn of(self, buffer: Buffer) -> u64 {
        match buffer {
            Buffer::Source => self.source,
            Buffer::Tables => self.tables,
            Buffer::Work(i) => self.work[i as usize],
        }
    }

    pub fn largest(self) -> u64 {
        self.work.into_iter().fold(self.params.max(self.tables).max(self.source).max(self.read), u64::max)
    }

    /// Bytes of the upload buffer: parameters, tables, then voxels.
    pub fn upload(self) -> u64 {
        self.params + self.tables + self.source
    }

    /// Bytes of host memory that a slot takes: staging, and on a software adapter everything.
    pub fn host_bytes(self, software: bool) -> u64 {
        let device = if software { self.upload() + self.work.iter().sum::<u64>() } else { 0 };
        self.upload() + self.read + STAMP_BYTES + device
    }
}

/// Most workgroups of a shader whose threads go on to other work when they are done: four times what a large GPU holds (H200:
/// 132 x 32; starting one more took it 0.8 ns, 2026-11-26, so that a copy of 16 bytes per thread reached 2.6 of 4 TB/s).
const MOST_GROUPS: u32 = 1 << 14;

/// Workgroups over x and y: no axis may exceed 65535.
pub fn groups(shader: Shader, entry: usize, threads: u32) -> [u32; 2] {
    let all = threads.div_ceil(GROUP).max(1);
    let all = if shader.goes_on(entry) { all.min(MOST_GROUPS) } else { all };
    let x = all.min(65535);
    [x, all.div_ceil(x)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_cover_all_threads_within_the_limit() {
        for threads in [1, 64, 65, 65535 * 64, 65535 * 64 + 1, u32::MAX - 64] {
            let [x, y] = groups(Shader::Extend, 0, threads);
            assert!(x <= 65535 && y <= 65535 && x as u64 * y as u64 * 64 >= threads as u64);
            let [x, y] = groups(Shader::Copy, 0, threads);
            assert!(x * y <= MOST_GROUPS.min(threads.div_ceil(64)));
        }
    }

    #[test]
    fn faults_are_seen() {
        let mut work = [0; WORK];
        work[0] = 512;
        let sizes = Sizes { params: 256, tables: 256, source: 256, work, read: 512 };
        let a = Buffer::Work(0);
        let dispatch = |bind: &[Buffer]| {
            let (shader, params) = (Shader::Sums32, vec![0; 80]);
            let bind = bind.iter().map(|b| Bind::from(*b)).collect();
            Command::Dispatch(Dispatch { shader, entry: 0, parts: 0, params, bind, threads: 1 })
        };
        let back = |from, bytes| Command::Readback(Readback { from: Bind { buffer: a, from }, bytes, to: 0 });
        let of = |commands: Vec<Command>| Recording { sizes, tables: vec![], commands }.fault();
        assert_eq!(
            of(vec![dispatch(&[Buffer::Source, a]), Command::Clear(a, 512), back(0, 512), back(256, 256)]),
            None
        );
        assert!(of(vec![dispatch(&[a, a])]).is_some());
        assert!(of(vec![dispatch(&[a])]).is_some());
        assert!(of(vec![dispatch(&[a, Buffer::Tables])]).is_some());
        assert!(of(vec![dispatch(&[Buffer::Source, Buffer::Work(1)])]).is_some(), "a buffer of no bytes");
        assert!(of(vec![back(0, 516)]).is_some() && of(vec![back(256, 260)]).is_some());
        assert!(of(vec![Command::Clear(Buffer::Work(1), 4)]).is_some());
        assert!(of(vec![dispatch(&[Buffer::Source, a]); 2]).is_some(), "parameters of two");
    }
}
