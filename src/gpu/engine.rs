//! Runs recordings on the device: map, fill, submit, map, finish; opens a lost device anew and tries once more.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};

use super::backend;
use super::device::{self, Device, Kind, SlotGuard};
use super::facts::{GpuFacts, GpuKind, SLOTS};
use super::record::{Command, Dispatch, Recording, STAMP_BYTES, STAMPS, groups};

/// Longest wait for one part. Parts take milliseconds on a GPU and seconds in software on a busy machine; a driver that
/// stays silent for longer is taken for lost.
const PATIENCE: Duration = Duration::from_secs(120);

/// Why the device did not make a brick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuError(pub String);

impl fmt::Display for GpuError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for GpuError {}

/// Seconds of the phases of a call, summed over its parts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Times {
    /// Making and mapping buffers, packing voxels into them.
    pub pack: f64,
    /// From submission until the results are mapped: copy to the device, passes, copy back, and the other slots' work.
    pub device: f64,
    /// From mapped sums to results, on the CPU.
    pub finish: f64,
    /// By the device's own clock: the copy there, the passes, the copy back. 0 without time stamps.
    pub stamps: [f64; 3],
    /// Each dispatch by the same clock, with its shader's name, in their order. Empty without time stamps, and where a part has
    /// more of them than there is room for.
    pub passes: Vec<(&'static str, f64)>,
}

impl Times {
    /// Adds a part's stamps: before the copy there, after it, after each command up to the last dispatch, after the copies back.
    fn stamp(&mut self, stamps: &[u64], commands: &[Command], tick: f64) {
        let seconds = |pair: [u64; 2]| pair[1].saturating_sub(pair[0]) as f64 * tick * 1e-9;
        let last = stamps.len() - 1;
        for (sum, pair) in self.stamps.iter_mut().zip([[0, 1], [1, last - 1], [last - 1, last]]) {
            *sum += seconds(pair.map(|k| stamps[k]));
        }
        if each(commands) {
            let made = commands.iter().zip(stamps[1..].windows(2));
            self.passes.extend(made.filter_map(|(command, pair)| match command {
                Command::Dispatch(d) => Some((d.shader.name(), seconds([pair[0], pair[1]]))),
                _ => None,
            }));
        }
    }
}

/// Whether there is room for a stamp after each command.
fn each(commands: &[Command]) -> bool {
    commands.len() + 3 <= STAMPS
}

/// The commands up to the last dispatch, and what comes back after it.
fn halves(recording: &Recording) -> (&[Command], &[Command]) {
    let last = recording.commands.iter().rposition(|c| matches!(c, Command::Dispatch(_)));
    recording.commands.split_at(last.map_or(0, |l| l + 1))
}

/// Time stamps of a part.
fn stamps_of(commands: &[Command]) -> usize {
    if each(commands) { commands.len() + 3 } else { 4 }
}

/// A GPU that runs kernels for any number of threads.
pub struct Gpu {
    kind: GpuKind,
    facts: GpuFacts,
    timed: bool,
    /// Most bytes of one buffer; larger calls are cut.
    cap: u64,
    /// Bricks on their way at once.
    slots: u64,
    device: Mutex<Option<Arc<Device>>>,
    /// No device can be opened any more (set by tests).
    gone: AtomicBool,
}

/// Writes voxels into the mapped upload buffer, behind parameters and tables; false where the device has nothing to do.
pub type Fill<'a> = &'a mut dyn FnMut(&mut wgpu::WriteOnly<[u8]>) -> bool;
/// Takes the results; `None` where the device had nothing to do.
pub type Finish<'a> = &'a mut dyn FnMut(Option<&[u8]>) -> Result<(), GpuError>;

impl Gpu {
    /// Opens the best adapter of this kind; the error says what was looked for and found.
    pub fn open(kind: GpuKind) -> Result<Gpu, String> {
        Gpu::open_with(kind, false)
    }

    /// As [`Gpu::open`], with time stamps where the adapter has them.
    pub fn open_timed(kind: GpuKind) -> Result<Gpu, String> {
        Gpu::open_with(kind, true)
    }

    fn open_with(kind: GpuKind, timed: bool) -> Result<Gpu, String> {
        let (device, facts) = device::open(kind, timed, SLOTS)?;
        let (cap, gone) = (facts.most_bytes, AtomicBool::new(false));
        let mut gpu = Gpu { kind, facts, timed, cap, slots: SLOTS, device: Mutex::new(Some(Arc::new(device))), gone };
        let name = gpu.facts.name.clone();
        let failed = |e: GpuError| format!("{name} does not compute: {e}");
        gpu.facts.exact_floats = gpu.probe().map_err(failed)?;
        gpu.facts.close_floats = backend::BOUNDS_ERRORS || gpu.probe_close().map_err(failed)?;
        Ok(gpu)
    }

    pub fn facts(&self) -> &GpuFacts {
        &self.facts
    }

    /// Holds each buffer to `bytes` (at most what the adapter allows); larger calls are cut into parts.
    pub fn set_cap(&mut self, bytes: u64) {
        self.cap = bytes.min(self.facts.most_bytes);
    }

    /// Bricks that are on their way at once; more calls wait.
    pub fn set_slots(&mut self, count: u64) {
        self.slots = count.max(1);
        if let Some(device) = &*self.device.lock().unwrap_or_else(|e| e.into_inner()) {
            device.set_slots(self.slots);
        }
    }

    /// Lets go of the buffers of the bricks before, whose shapes no brick may have again; calls on their way keep theirs.
    pub fn let_go(&self) {
        if let Some(device) = &*self.device.lock().unwrap_or_else(|e| e.into_inner()) {
            device.let_go();
        }
    }

    /// Bytes of the buffers that wait for the next brick, the device's and the host's.
    pub fn idle_bytes(&self) -> u64 {
        let held = self.device.lock().unwrap_or_else(|e| e.into_inner()).clone();
        held.map_or(0, |d| d.idle_bytes())
    }

    pub(super) fn cap(&self) -> u64 {
        self.cap
    }

    /// Whether a call would have to wait for others to leave a slot.
    pub fn is_busy(&self) -> bool {
        let held = self.device.lock().unwrap_or_else(|e| e.into_inner()).clone();
        held.is_some_and(|d| d.is_busy())
    }

    /// Runs `call` on the device; after a failure once more, on a device opened anew.
    ///
    /// # Errors
    /// A second failure.
    pub(super) fn attempt<T>(&self, mut call: impl FnMut(&Device) -> Result<T, GpuError>) -> Result<T, GpuError> {
        let mut once = || {
            let device = self.device()?;
            call(&device).inspect_err(|_| self.forget(&device))
        };
        let first = match once() {
            Ok(done) => return Ok(done),
            Err(error) => error,
        };
        once().map_err(|e| {
            GpuError(format!("{}: {e}; before that, on the device as first opened: {first}", self.facts.name))
        })
    }

    /// The open device, opened anew where it was lost.
    fn device(&self) -> Result<Arc<Device>, GpuError> {
        let mut held = self.device.lock().unwrap_or_else(|e| e.into_inner());
        if let Some(device) = &*held {
            return Ok(device.clone());
        }
        if self.gone.load(Ordering::Relaxed) {
            return Err(GpuError("the device was lost, and no other is there".into()));
        }
        let opened = device::open(self.kind, self.timed, self.slots);
        let (device, _) = opened.map_err(|e| GpuError(format!("the device was lost; {e}")))?;
        Ok(held.insert(Arc::new(device)).clone())
    }

    /// Drops a device that failed, unless another thread has already replaced it.
    fn forget(&self, failed: &Arc<Device>) {
        let mut held = self.device.lock().unwrap_or_else(|e| e.into_inner());
        if held.as_ref().is_some_and(|d| Arc::ptr_eq(d, failed)) {
            *held = None;
        }
    }

    /// Destroys the device under the lane, as a driver reset would, so that it can be opened anew or not. For tests.
    #[doc(hidden)]
    pub fn lose(&self, for_good: bool) {
        self.gone.store(for_good, Ordering::Relaxed);
        if let Some(device) = &*self.device.lock().unwrap_or_else(|e| e.into_inner()) {
            device.device.destroy();
        }
    }
}

/// One part from voxels to results.
pub fn run_part(
    device: &Device,
    recording: &Recording,
    fill: Fill,
    finish: Finish,
    times: &mut Times,
) -> Result<(), GpuError> {
    debug_assert_eq!(recording.fault(), None);
    let mut held = device.take_slot();
    let scopes = [wgpu::ErrorFilter::Internal, wgpu::ErrorFilter::OutOfMemory, wgpu::ErrorFilter::Validation]
        .map(|f| device.device.push_error_scope(f));
    let result = on_device(device, &mut held, recording, fill, finish, times);
    // The innermost first. What a scope caught explains what failed after it.
    let mut caught = None;
    for scope in scopes.into_iter().rev() {
        caught = pollster::block_on(scope.pop()).or(caught);
    }
    let fault = device.fault.lock().unwrap_or_else(|e| e.into_inner()).clone();
    let error = match (caught, fault, result) {
        (Some(error), ..) => GpuError(error.to_string()),
        (None, Some(fault), _) => GpuError(fault),
        (None, None, result) => match result {
            Ok(()) => return Ok(()),
            Err(error) => error,
        },
    };
    held.slot.clear();
    Err(error)
}

fn on_device(
    device: &Device,
    held: &mut SlotGuard,
    recording: &Recording,
    fill: Fill,
    finish: Finish,
    times: &mut Times,
) -> Result<(), GpuError> {
    let sizes = recording.sizes;
    let slot = &mut held.slot;
    slot.grow(&device.device, sizes);
    device.compile(recording.dispatches().map(kind));
    let start = Instant::now();
    map(device, slot.upload.get(), wgpu::MapMode::Write, sizes.upload(), None)?;
    let work = write(slot.upload.get(), recording, fill)?;
    slot.upload.get().unmap();
    times.pack += start.elapsed().as_secs_f64();
    if !work {
        return finish(None);
    }
    let start = Instant::now();
    let index = submit(device, held, recording);
    let read = held.slot.read.get();
    let bytes = sizes.read + STAMP_BYTES;
    map(device, read, wgpu::MapMode::Read, bytes, Some(index))?;
    times.device += start.elapsed().as_secs_f64();
    let start = Instant::now();
    {
        let bytes = read.get_mapped_range(0..bytes).map_err(|e| GpuError(format!("cannot read results: {e:?}")))?;
        let (results, stamps) = bytes.split_at(sizes.read as usize);
        finish(Some(results))?;
        if let Some(tick) = device.tick {
            let (compute, _) = halves(recording);
            if let Ok(stamps) = bytemuck::try_cast_slice(&stamps[..8 * stamps_of(compute)]) {
                times.stamp(stamps, compute, tick);
            }
        }
    }
    read.unmap();
    times.finish += start.elapsed().as_secs_f64();
    Ok(())
}

/// Maps a buffer and waits for it (and for a submission).
fn map(
    device: &Device,
    buffer: &wgpu::Buffer,
    mode: wgpu::MapMode,
    bytes: u64,
    submission_index: Option<wgpu::SubmissionIndex>,
) -> Result<(), GpuError> {
    let (tell, told) = mpsc::channel();
    buffer.map_async(mode, 0..bytes, move |result| {
        let _ = tell.send(result);
    });
    if submission_index.is_some() {
        let wait = wgpu::PollType::Wait { submission_index, timeout: Some(PATIENCE) };
        device.device.poll(wait).map_err(|e| GpuError(format!("no answer from the device: {e}")))?;
    }
    // An idle buffer maps at the next poll, whoever polls; a callback may run on another worker's thread.
    let end = Instant::now() + PATIENCE;
    loop {
        let _ = device.device.poll(wgpu::PollType::Poll);
        match told.recv_timeout(Duration::from_millis(1)) {
            Ok(Ok(())) => return Ok(()),
            Ok(Err(e)) => return Err(GpuError(format!("cannot map a buffer: {e}"))),
            Err(mpsc::RecvTimeoutError::Disconnected) => return Err(GpuError("a mapping was dropped".into())),
            Err(mpsc::RecvTimeoutError::Timeout) if Instant::now() > end => {
                return Err(GpuError("no answer from the device".into()));
            }
            Err(mpsc::RecvTimeoutError::Timeout) => {}
        }
    }
}

/// Writes parameters, tables and voxels into the mapped upload buffer; false where there is no work.
fn write(buffer: &wgpu::Buffer, recording: &Recording, fill: Fill) -> Result<bool, GpuError> {
    let sizes = recording.sizes;
    let view = buffer.get_mapped_range_mut(0..sizes.upload());
    let mut view = view.map_err(|e| GpuError(format!("cannot write voxels: {e:?}")))?;
    for (dispatch, at) in recording.dispatches().zip(recording.params()) {
        view.slice(at.start as usize..at.end as usize).copy_from_slice(&dispatch.params);
    }
    let tables: &[u8] = bytemuck::cast_slice(&recording.tables);
    let from = sizes.params as usize;
    view.slice(from..from + tables.len()).copy_from_slice(tables);
    let from = (sizes.params + sizes.tables) as usize;
    Ok(fill(&mut view.slice(from..from + sizes.source as usize)))
}

/// Encodes and submits the copies and passes of a part.
fn submit(device: &Device, held: &SlotGuard, recording: &Recording) -> wgpu::SubmissionIndex {
    let (slot, sizes) = (&held.slot, recording.sizes);
    let (compute, back) = halves(recording);
    let count = stamps_of(compute) as u32;
    let stamps = device.tick.map(|_| {
        let ty = wgpu::QueryType::Timestamp;
        device.device.create_query_set(&wgpu::QuerySetDescriptor { label: None, ty, count })
    });
    let mut encoder = device.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("part") });
    let stamp = |encoder: &mut wgpu::CommandEncoder, k: u32| {
        stamps.iter().for_each(|s| encoder.write_timestamp(s, k));
    };
    stamp(&mut encoder, 0);
    let mut from = 0;
    for (to, bytes) in [(&slot.params, sizes.params), (&slot.tables, sizes.tables), (&slot.source, sizes.source)] {
        if bytes > 0 {
            encoder.copy_buffer_to_buffer(slot.upload.get(), from, to.get(), 0, bytes);
        }
        from += bytes;
    }
    stamp(&mut encoder, 1);
    let mut params = recording.params();
    if stamps.is_some() && each(compute) {
        for (command, k) in compute.chunks(1).zip(2..) {
            encode(device, held, command, &mut params, &mut encoder);
            stamp(&mut encoder, k);
        }
    } else {
        encode(device, held, compute, &mut params, &mut encoder);
        stamp(&mut encoder, 2);
    }
    encode(device, held, back, &mut params, &mut encoder);
    stamp(&mut encoder, count - 1);
    if let Some(set) = &stamps {
        let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
        let size = 8 * count as u64;
        let desc = wgpu::BufferDescriptor { label: Some("stamps"), size, usage, mapped_at_creation: false };
        let resolved = device.device.create_buffer(&desc);
        encoder.resolve_query_set(set, 0..count, &resolved, 0);
        encoder.copy_buffer_to_buffer(&resolved, 0, slot.read.get(), sizes.read, size);
    }
    device.queue.submit([encoder.finish()])
}

/// Commands in their order; dispatches in a row share a pass. `params` says where those of the next dispatch stand.
fn encode(
    device: &Device,
    held: &SlotGuard,
    commands: &[Command],
    params: &mut impl Iterator<Item = std::ops::Range<u64>>,
    encoder: &mut wgpu::CommandEncoder,
) {
    let slot = &held.slot;
    for run in commands.chunk_by(|a, b| matches!((a, b), (Command::Dispatch(_), Command::Dispatch(_)))) {
        match &run[0] {
            Command::Readback(r) => {
                encoder.copy_buffer_to_buffer(slot.of(r.from.buffer), r.from.from, slot.read.get(), r.to, r.bytes);
            }
            Command::Clear(buffer, bytes) => encoder.clear_buffer(slot.of(*buffer), 0, Some(*bytes)),
            Command::Dispatch(_) => {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                for command in run {
                    if let (Command::Dispatch(d), Some(at)) = (command, params.next()) {
                        dispatch(device, held, d, at.start, &mut pass);
                    }
                }
            }
        }
    }
}

fn kind(d: &Dispatch) -> Kind {
    Kind { shader: d.shader, entry: d.entry, parts: d.parts }
}

fn dispatch(device: &Device, held: &SlotGuard, d: &Dispatch, offset: u64, pass: &mut wgpu::ComputePass) {
    let kernel = device.kernel(kind(d));
    let size = wgpu::BufferSize::new(d.params.len() as u64);
    let params = wgpu::BufferBinding { buffer: held.slot.params.get(), offset, size };
    let mut entries = vec![wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::Buffer(params) }];
    entries.extend(d.bind.iter().zip(1..).map(|(b, binding)| {
        let buffer = wgpu::BufferBinding { buffer: held.slot.of(b.buffer), offset: b.from, size: None };
        wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::Buffer(buffer) }
    }));
    let desc = wgpu::BindGroupDescriptor { label: None, layout: &kernel.layout, entries: &entries };
    let bind = device.device.create_bind_group(&desc);
    pass.set_pipeline(&kernel.pipeline);
    pass.set_bind_group(0, &bind, &[]);
    let [x, y] = groups(d.shader, d.entry, d.threads);
    pass.dispatch_workgroups(x, y, 1);
}
