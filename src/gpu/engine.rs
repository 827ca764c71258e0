//! Window kernels on the device: pack and upload, three passes per quantity, read back, finish with the CPU's rows.

use std::fmt;
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};

use super::device::{self, Device, SlotGuard};
use super::facts::{self, GpuFacts, GpuKind};
use super::passes::{Job, PASS_STRIDE, Part, Quantity, Sizes, groups};
use crate::grid::{AnyView, View, Voxel};
use crate::kernel::Context;
use crate::kernel::window::finish::{Sums, Windows, finish};
use crate::kernel::window::{self, Needs, WindowOut};
use crate::stage::WindowParams;

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
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Times {
    /// Making and mapping buffers, packing voxels into them.
    pub pack: f64,
    /// From submission until the results are mapped: copy to the device, passes, copy back, and the other slot's work.
    pub device: f64,
    /// From mapped sums to results, on the CPU.
    pub finish: f64,
}

/// A GPU that runs window kernels for any number of threads.
pub struct Gpu {
    kind: GpuKind,
    facts: GpuFacts,
    /// Most bytes of one buffer; larger calls are cut.
    cap: u64,
    device: Mutex<Option<Arc<Device>>>,
}

impl Gpu {
    /// Opens the best Vulkan adapter of this kind; the error says what was looked for and found.
    pub fn open(kind: GpuKind) -> Result<Gpu, String> {
        let (device, facts) = device::open(kind)?;
        let cap = facts.most_bytes;
        Ok(Gpu { kind, facts, cap, device: Mutex::new(Some(Arc::new(device))) })
    }

    pub fn facts(&self) -> &GpuFacts {
        &self.facts
    }

    /// Holds each buffer to `bytes` (at most what the adapter allows); larger calls are cut into parts.
    pub fn set_cap(&mut self, bytes: u64) {
        self.cap = bytes.min(self.facts.most_bytes);
    }

    /// The same as [`window::window`], bit for bit, for inputs that [`super::facts::window`] admits. Windows too large for
    /// the device even one voxel at a time are computed by the CPU kernel. After a failure the device is opened anew and
    /// the call tried once more.
    ///
    /// Panics where [`window::window`] does.
    ///
    /// # Errors
    /// An input without a kernel, or a second failure of the device.
    pub fn window(
        &self,
        src: AnyView,
        params: &WindowParams,
        at: [usize; 3],
        outs: &mut [WindowOut],
        cx: &mut Context,
    ) -> Result<Times, GpuError> {
        let channels: Vec<_> = outs.iter().map(|o| o.channel).collect();
        facts::window(src.dtype(), params.missing.is_some(), &channels).map_err(|e| GpuError(e.into()))?;
        let Some(dst) = outs.first().map(|o| o.dst.shape()) else { return Ok(Times::default()) };
        assert!((0..3).all(|a| at[a] + dst[a] <= src.shape()[a]), "output {dst:?} at {at:?} sticks out");
        if dst.contains(&0) {
            return Ok(Times::default());
        }
        let needs = Needs::of(channels.into_iter(), false);
        let job = Job::new(src.dtype(), src.shape(), dst, at, params.radius, needs);
        let Some((job, parts)) = job.and_then(|j| Some((j, j.parts(self.cap)?))) else {
            window::window(src, params, window::Place::whole(at), outs, cx); // integers are exact
            return Ok(Times::default());
        };
        let run = |outs: &mut [WindowOut], cx: &mut Context| {
            let device = self.device()?;
            let mut times = Times::default();
            for part in &parts {
                let result = run_part(&device, &job, part, src, params, outs, &mut times, cx);
                if let Err(error) = result {
                    self.forget(&device);
                    return Err(error);
                }
            }
            Ok(times)
        };
        let first = match run(outs, cx) {
            Ok(times) => return Ok(times),
            Err(error) => error,
        };
        run(outs, cx).map_err(|e| {
            GpuError(format!("{}: {e}; before that, on the device as first opened: {first}", self.facts.name))
        })
    }

    /// The open device, opened anew where it was lost.
    fn device(&self) -> Result<Arc<Device>, GpuError> {
        let mut held = self.device.lock().unwrap_or_else(|e| e.into_inner());
        if let Some(device) = &*held {
            return Ok(device.clone());
        }
        let (device, _) = device::open(self.kind).map_err(|e| GpuError(format!("the device was lost; {e}")))?;
        Ok(held.insert(Arc::new(device)).clone())
    }

    /// Drops a device that failed, unless another thread has already replaced it.
    fn forget(&self, failed: &Arc<Device>) {
        let mut held = self.device.lock().unwrap_or_else(|e| e.into_inner());
        if held.as_ref().is_some_and(|d| Arc::ptr_eq(d, failed)) {
            *held = None;
        }
    }

    /// Destroys the device under the lane, as a driver reset would. For tests.
    #[doc(hidden)]
    pub fn lose(&self) {
        if let Some(device) = &*self.device.lock().unwrap_or_else(|e| e.into_inner()) {
            device.device.destroy();
        }
    }
}

/// One part from voxels to results.
#[allow(clippy::too_many_arguments)]
fn run_part(
    device: &Device,
    job: &Job,
    part: &Part,
    src: AnyView,
    params: &WindowParams,
    outs: &mut [WindowOut],
    times: &mut Times,
    cx: &mut Context,
) -> Result<(), GpuError> {
    let mut held = device.take_slot();
    let scopes = [wgpu::ErrorFilter::Internal, wgpu::ErrorFilter::OutOfMemory, wgpu::ErrorFilter::Validation]
        .map(|f| device.device.push_error_scope(f));
    let result = on_device(device, &mut held, job, part, src, params, outs, times, cx);
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

#[allow(clippy::too_many_arguments)]
fn on_device(
    device: &Device,
    held: &mut SlotGuard,
    job: &Job,
    part: &Part,
    src: AnyView,
    params: &WindowParams,
    outs: &mut [WindowOut],
    times: &mut Times,
    cx: &mut Context,
) -> Result<(), GpuError> {
    let (sizes, quantities) = (job.sizes(part), job.quantities());
    let slot = &mut held.slot;
    slot.grow(&device.device, sizes);
    let start = Instant::now();
    map(device, slot.upload.get(), wgpu::MapMode::Write, sizes.upload(), None)?;
    fill(slot.upload.get(), job, part, &quantities, src, sizes)?;
    slot.upload.get().unmap();
    times.pack += start.elapsed().as_secs_f64();
    let start = Instant::now();
    let index = submit(device, held, job, part, &quantities, sizes);
    let read = held.slot.read.get();
    map(device, read, wgpu::MapMode::Read, sizes.read, Some(index))?;
    times.device += start.elapsed().as_secs_f64();
    let start = Instant::now();
    {
        let bytes =
            read.get_mapped_range(0..sizes.read).map_err(|e| GpuError(format!("cannot read results: {e:?}")))?;
        let windows = windows(&bytes, part, &quantities)?;
        finish(src, params, job.at, outs, &windows, cx);
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

/// Writes the parameters of the passes and the packed voxels of a part into the mapped upload buffer.
fn fill(
    buffer: &wgpu::Buffer,
    job: &Job,
    part: &Part,
    quantities: &[Quantity],
    src: AnyView,
    sizes: Sizes,
) -> Result<(), GpuError> {
    let view = buffer.get_mapped_range_mut(0..sizes.upload());
    let mut view = view.map_err(|e| GpuError(format!("cannot write voxels: {e:?}")))?;
    for (k, pass) in quantities.iter().flat_map(|q| job.passes(part, *q)).enumerate() {
        let bytes = bytemuck::bytes_of(&pass);
        let from = k * PASS_STRIDE as usize;
        view.slice(from..from + bytes.len()).copy_from_slice(bytes);
    }
    let from = sizes.upload() as usize - sizes.source as usize;
    let pitch = job.pitch(part) * job.voxel;
    let mut rows = view.slice(from..from + pitch * part.src[0] * part.src[1]);
    fn write<T: Voxel + bytemuck::Pod>(v: View<T>, part: &Part, pitch: usize, out: &mut wgpu::WriteOnly<[u8]>) {
        let v = v.part(part.from, part.src);
        for z in 0..part.src[0] {
            for y in 0..part.src[1] {
                let bytes: &[u8] = bytemuck::cast_slice(v.row_at(z, y));
                let from = (z * part.src[1] + y) * pitch;
                // The padding at the end of a row is never read by a shader.
                out.slice(from..from + bytes.len()).copy_from_slice(bytes);
            }
        }
    }
    match src {
        AnyView::U8(v) => write(v, part, pitch, &mut rows),
        AnyView::I8(v) => write(v, part, pitch, &mut rows),
        AnyView::U16(v) => write(v, part, pitch, &mut rows),
        AnyView::I16(v) => write(v, part, pitch, &mut rows),
        other => return Err(GpuError(format!("no GPU kernel for {}", other.dtype()))),
    }
    Ok(())
}

/// Encodes and submits the copies and passes of a part.
fn submit(
    device: &Device,
    held: &SlotGuard,
    job: &Job,
    part: &Part,
    quantities: &[Quantity],
    sizes: Sizes,
) -> wgpu::SubmissionIndex {
    let slot = &held.slot;
    let (source, a, b) = (slot.source.get(), slot.a.get(), slot.b.get());
    let params_bytes = sizes.upload() - sizes.source;
    let mut encoder = device.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("part") });
    encoder.copy_buffer_to_buffer(slot.upload.get(), 0, slot.params.get(), 0, params_bytes);
    encoder.copy_buffer_to_buffer(slot.upload.get(), params_bytes, source, 0, sizes.source);
    let (mut number, mut place) = (0, 0);
    for &quantity in quantities {
        for (axis, pass) in job.passes(part, quantity).into_iter().enumerate() {
            let (input, output) = [(source, a), (a, b), (b, a)][axis];
            let offset = number * PASS_STRIDE;
            let params = wgpu::BufferBinding {
                buffer: slot.params.get(),
                offset,
                size: wgpu::BufferSize::new(size_of_val(&pass) as u64),
            };
            let bind = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: None,
                layout: &device.layout,
                entries: &[
                    wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::Buffer(params) },
                    wgpu::BindGroupEntry { binding: 1, resource: input.as_entire_binding() },
                    wgpu::BindGroupEntry { binding: 2, resource: output.as_entire_binding() },
                ],
            });
            let mut compute = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            compute.set_pipeline(device.pipeline(quantity, axis));
            compute.set_bind_group(0, &bind, &[]);
            let [x, y] = groups(&pass);
            compute.dispatch_workgroups(x, y, 1);
            number += 1;
        }
        let bytes = result_bytes(part, quantity);
        encoder.copy_buffer_to_buffer(a, 0, slot.read.get(), place, bytes);
        place += bytes.next_multiple_of(256);
    }
    device.queue.submit([encoder.finish()])
}

fn result_bytes(part: &Part, quantity: Quantity) -> u64 {
    part.dst.iter().map(|&n| n as u64).product::<u64>() * quantity.bytes()
}

/// The mapped results of a part by quantity.
fn windows<'a>(bytes: &'a [u8], part: &Part, quantities: &[Quantity]) -> Result<Windows<'a>, GpuError> {
    fn cast<T: bytemuck::Pod>(bytes: &[u8]) -> Result<&[T], GpuError> {
        bytemuck::try_cast_slice(bytes).map_err(|e| GpuError(format!("results are not aligned: {e}")))
    }
    let mut out = Windows { lo: part.lo, shape: part.dst, extremes: &[], s1: Sums::None, s2: Sums::None };
    let mut place = 0;
    for &quantity in quantities {
        let len = result_bytes(part, quantity) as usize;
        let slice = &bytes[place..place + len];
        match quantity {
            Quantity::Extremes => out.extremes = cast(slice)?,
            Quantity::Sum { square, wide } => {
                let sums = if wide { Sums::Wide(cast(slice)?) } else { Sums::Narrow(cast(slice)?) };
                *(if square { &mut out.s2 } else { &mut out.s1 }) = sums;
            }
        }
        place += len.next_multiple_of(256);
    }
    Ok(out)
}
