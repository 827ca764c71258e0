//! What the device does with one part of a brick, as data: buffers, dispatches and what comes back. Recording asks for no
//! device, so that tests can look at it without one.

pub use super::shaders::Shader;

/// Bytes between the parameters of dispatches in their buffer (the largest alignment that an adapter may ask for).
pub const PARAMS_STRIDE: u64 = 256;
/// Room for time stamps behind the results.
pub const STAMP_BYTES: u64 = 256;
/// Threads of a workgroup; in every shader.
pub const GROUP: u32 = 64;

/// Device buffers of a slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Buffer {
    /// Packed voxels, written by the host.
    Source,
    /// Tables, written by the host.
    Tables,
    A,
    B,
    C,
    /// Results of a first step that a second one reads.
    D,
}

/// One dispatch.
#[derive(Debug, Clone, PartialEq)]
pub struct Dispatch {
    pub shader: Shader,
    /// Index into [`Shader::entries`].
    pub entry: usize,
    /// The shader's uniform struct.
    pub params: Vec<u8>,
    /// [`Shader::bindings`] of them.
    pub bind: Vec<Buffer>,
    pub threads: u32,
}

/// Bytes that come back, from the start of a buffer to a place of the results.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Readback {
    pub from: Buffer,
    pub bytes: u64,
    pub to: u64,
}

/// A step of the device's work.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    Dispatch(Dispatch),
    Readback(Readback),
}

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
            Command::Readback(_) => None,
        })
    }

    /// What is wrong with it, if anything: bindings that a shader lacks or that alias, copies beyond a buffer's end.
    pub fn fault(&self) -> Option<String> {
        if self.dispatches().count() as u64 * PARAMS_STRIDE > self.sizes.params {
            return Some("too little room for parameters".into());
        }
        if self.tables.len() as u64 * 4 > self.sizes.tables {
            return Some("too little room for tables".into());
        }
        for command in &self.commands {
            match command {
                Command::Dispatch(d) => {
                    let twice = d.bind.iter().enumerate().any(|(i, b)| d.bind[..i].contains(b));
                    let written = d.bind.iter().skip(1).step_by(2);
                    if d.bind.len() != d.shader.bindings() || d.entry >= d.shader.entries().len() || twice {
                        return Some(format!("{}: bindings {:?}, entry {}", d.shader.name(), d.bind, d.entry));
                    }
                    if d.params.len() as u64 > PARAMS_STRIDE || d.threads == 0 {
                        return Some(format!("{}: {} threads", d.shader.name(), d.threads));
                    }
                    if written.into_iter().any(|b| matches!(b, Buffer::Source | Buffer::Tables)) {
                        return Some(format!("{} writes what the host wrote", d.shader.name()));
                    }
                }
                Command::Readback(r) => {
                    if r.bytes > self.sizes.of(r.from) || r.to + r.bytes > self.sizes.read || r.to % 256 != 0 {
                        return Some(format!("{r:?} of {:?}", self.sizes));
                    }
                }
            }
        }
        None
    }
}

/// Bytes of the buffers of a slot, all multiples of 256.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Sizes {
    pub params: u64,
    pub tables: u64,
    pub source: u64,
    pub a: u64,
    pub b: u64,
    pub c: u64,
    pub d: u64,
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
            a: self.a.max(o.a),
            b: self.b.max(o.b),
            c: self.c.max(o.c),
            d: self.d.max(o.d),
            read: self.read.max(o.read),
        }
    }

    pub fn of(self, buffer: Buffer) -> u64 {
        match buffer {
            Buffer::Source => self.source,
            Buffer::Tables => self.tables,
            Buffer::A => self.a,
            Buffer::B => self.b,
            Buffer::C => self.c,
            Buffer::D => self.d,
        }
    }

    pub fn largest(self) -> u64 {
        self.params.max(self.tables).max(self.source).max(self.a).max(self.b).max(self.c).max(self.d).max(self.read)
    }

    /// Bytes of the upload buffer: parameters, tables, then voxels.
    pub fn upload(self) -> u64 {
        self.params + self.tables + self.source
    }

    /// Bytes of host memory that a slot takes: staging, and on a software adapter everything.
    pub fn host_bytes(self, software: bool) -> u64 {
        let device = if software { self.upload() + self.a + self.b + self.c + self.d } else { 0 };
        self.upload() + self.read + STAMP_BYTES + device
    }
}

/// Workgroups over x and y: no axis may exceed 65535.
pub fn groups(threads: u32) -> [u32; 2] {
    let all = threads.div_ceil(GROUP).max(1);
    let x = all.min(65535);
    [x, all.div_ceil(x)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_cover_all_threads_within_the_limit() {
        for threads in [1, 64, 65, 65535 * 64, 65535 * 64 + 1, u32::MAX - 64] {
            let [x, y] = groups(threads);
            assert!(x <= 65535 && y <= 65535 && x as u64 * y as u64 * 64 >= threads as u64);
        }
    }

    #[test]
    fn faults_are_seen() {
        let sizes = Sizes { params: 256, tables: 256, source: 256, a: 512, b: 256, c: 0, d: 0, read: 512 };
        let dispatch = |bind: &[Buffer]| {
            let (shader, params) = (Shader::Sums32, vec![0; 80]);
            Command::Dispatch(Dispatch { shader, entry: 0, params, bind: bind.to_vec(), threads: 1 })
        };
        let back = |bytes| Command::Readback(Readback { from: Buffer::A, bytes, to: 0 });
        let of = |commands: Vec<Command>| Recording { sizes, tables: vec![], commands }.fault();
        assert_eq!(of(vec![dispatch(&[Buffer::Source, Buffer::A]), back(512)]), None);
        assert!(of(vec![dispatch(&[Buffer::A, Buffer::A])]).is_some());
        assert!(of(vec![dispatch(&[Buffer::A])]).is_some());
        assert!(of(vec![dispatch(&[Buffer::A, Buffer::Tables])]).is_some());
        assert!(of(vec![back(513)]).is_some());
        assert!(of(vec![dispatch(&[Buffer::Source, Buffer::A]); 2]).is_some(), "parameters of two");
    }
}
