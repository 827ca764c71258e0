//! Finds an adapter and opens it: by the system's own way only, ranked by device type, software refused unless asked for by name.

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Condvar, Mutex, OnceLock};

use super::backend;
use super::facts::{GpuFacts, GpuKind};
use super::shaders::{MOST_BINDINGS, Shader};
use super::slot::Slot;

/// An open device with its pipelines and slots. Dropped and opened anew after a failure.
pub struct Device {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    /// Made when they are first used.
    kernels: Mutex<HashMap<Kind, Arc<OnceLock<Arc<Kernel>>>>>,
    /// Nanoseconds of a tick of the time stamps, where they were asked for and there are any.
    pub tick: Option<f64>,
    slots: Mutex<Vec<Slot>>,
    idle: Condvar,
    /// What the driver reported outside of any call's error scopes, and the loss of the device.
    pub fault: Arc<Mutex<Option<String>>>,
}

/// What is compiled: an entry point of a shader, of which only some parts are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Kind {
    pub shader: Shader,
    pub entry: usize,
    pub parts: u32,
}

/// An entry point's layout of bindings and pipeline.
pub struct Kernel {
    pub layout: wgpu::BindGroupLayout,
    pub pipeline: wgpu::ComputePipeline,
}

/// Preference; software comes in only when asked for.
fn rank(kind: wgpu::DeviceType) -> u32 {
    match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    }
}

/// The best adapter of this kind, or what was looked for and found.
fn adapter(kind: GpuKind) -> Result<wgpu::Adapter, String> {
    // Flags are named rather than taken from the build type, and no variable of the environment changes the choice.
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: backend::BACKENDS,
        flags: wgpu::InstanceFlags::empty(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let all = pollster::block_on(instance.enumerate_adapters(backend::BACKENDS));
    let found: Vec<String> =
        all.iter().map(|a| a.get_info()).map(|i| format!("{} ({:?})", i.name, i.device_type)).collect();
    let fits = |a: &wgpu::Adapter| {
        let software = a.get_info().device_type == wgpu::DeviceType::Cpu;
        software == (kind == GpuKind::Software)
    };
    all.into_iter().filter(fits).min_by_key(|a| rank(a.get_info().device_type)).ok_or_else(|| {
        let name = backend::NAME;
        let wanted = match kind {
            GpuKind::Hardware => format!("a {name} driver of a hardware GPU"),
            GpuKind::Software => format!("a {name} driver in software, {}", backend::SOFTWARE),
        };
        let found = if found.is_empty() { format!("no {name} adapter") } else { found.join(", ") };
        format!("looked for {wanted}; found {found}")
    })
}

/// Opens a device of this kind with so many slots; `timed` asks for time stamps, which it may not have.
pub fn open(kind: GpuKind, timed: bool, slots: u64) -> Result<(Device, GpuFacts), String> {
    let adapter = adapter(kind)?;
    let stamps = wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS;
    let timed = timed && adapter.features().contains(stamps);
    let info = adapter.get_info();
    let limits = adapter.limits();
    let wanted = wgpu::Limits {
        max_buffer_size: limits.max_buffer_size,
        max_storage_buffer_binding_size: limits.max_storage_buffer_binding_size,
        max_storage_buffers_per_shader_stage: MOST_BINDINGS,
        ..wgpu::Limits::downlevel_defaults()
    };
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        label: Some("occlude"),
        required_features: if timed { stamps } else { wgpu::Features::empty() },
        required_limits: wanted,
        experimental_features: wgpu::ExperimentalFeatures::disabled(),
        memory_hints: wgpu::MemoryHints::MemoryUsage,
        trace: wgpu::Trace::Off,
    }))
    .map_err(|e| format!("{} cannot be opened: {e}", info.name))?;
    let fault = Arc::new(Mutex::new(None));
    let note = |fault: &Arc<Mutex<Option<String>>>| {
        let fault = fault.clone();
        move |text: String| {
            fault.lock().unwrap_or_else(|e| e.into_inner()).get_or_insert(text);
        }
    };
    let (on_error, on_loss) = (note(&fault), note(&fault));
    device.on_uncaptured_error(Arc::new(move |e| on_error(e.to_string())));
    device.set_device_lost_callback(move |reason, text| on_loss(format!("device lost ({reason:?}): {text}")));
    let facts = GpuFacts {
        name: info.name.clone(),
        software: info.device_type == wgpu::DeviceType::Cpu,
        most_bytes: limits.max_buffer_size.min(limits.max_storage_buffer_binding_size).min(1 << 30),
        exact_floats: false, // until the probe has said so
        close_floats: false,
    };
    let tick = timed.then(|| queue.get_timestamp_period() as f64);
    let kernels = Mutex::new(HashMap::new());
    let slots = (0..slots).map(|_| Slot::default()).collect();
    let (slots, idle) = (Mutex::new(slots), Condvar::new());
    Ok((Device { device, queue, kernels, tick, slots, idle, fault }, facts))
}

fn kernel(device: &wgpu::Device, kind: Kind) -> Kernel {
    let shader = kind.shader;
    let name = shader.name();
    let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    let storage = |k: u32| entry(k, wgpu::BufferBindingType::Storage { read_only: !shader.writes(k as usize) });
    let mut entries = vec![entry(0, wgpu::BufferBindingType::Uniform)];
    entries.extend((1..=shader.bindings() as u32).map(storage));
    let desc = wgpu::BindGroupLayoutDescriptor { label: Some(name), entries: &entries };
    let layout = device.create_bind_group_layout(&desc);
    let shared = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(name),
        bind_group_layouts: &[Some(&layout)],
        immediate_size: 0,
    });
    let source = wgpu::ShaderSource::Wgsl(shader.text().into());
    let module = wgpu::ShaderModuleDescriptor { label: Some(name), source };
    // SAFETY: indices come from extents and strides that the recorders make with the sizes of the buffers (a driver that can
    // checks them all the same, and lavapipe does in the tests); every loop of the shaders counts up or down to a bound that does
    // not change in it (`seek` steps by at least one, and goes down a stack that has an end), so none is endless; every divisor is a
    // constant, or an extent or a count of the parameters, which recorders keep above 0; there are no rays and no meshes.
    let module = unsafe { device.create_shader_module_trusted(module, wgpu::ShaderRuntimeChecks::unchecked()) };
    let parts = [("parts", kind.parts as f64)];
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(name),
        layout: Some(&shared),
        module: &module,
        entry_point: Some(shader.entries()[kind.entry]),
        // Nothing that is kept is made of workgroup memory that was not written before.
        compilation_options: wgpu::PipelineCompilationOptions {
            zero_initialize_workgroup_memory: false,
            constants: if shader.has_parts() { &parts } else { &[] },
        },
        cache: None,
    });
    Kernel { layout, pipeline }
}

impl Device {
    /// The pipeline of an entry point. What the driver says against it comes through the device's error scopes.
    pub fn kernel(&self, kind: Kind) -> Arc<Kernel> {
        let place = self.kernels.lock().unwrap_or_else(|e| e.into_inner()).entry(kind).or_default().clone();
        place.get_or_init(|| Arc::new(kernel(&self.device, kind))).clone()
    }

    /// Compiles those that are not there yet side by side: drivers keep what they compiled, but a first run waits for all of
    /// it. What a driver says against one comes as a fault of the device.
    pub fn compile(&self, kinds: impl Iterator<Item = Kind>) {
        let missing: HashSet<Kind> = {
            let kernels = self.kernels.lock().unwrap_or_else(|e| e.into_inner());
            kinds.filter(|k| kernels.get(k).is_none_or(|place| place.get().is_none())).collect()
        };
        if missing.len() > 1 {
            std::thread::scope(|scope| missing.iter().for_each(|kind| drop(scope.spawn(|| self.kernel(*kind)))));
        }
    }

    /// Whether a call would have to wait for a slot.
    pub fn is_busy(&self) -> bool {
        self.slots.lock().unwrap_or_else(|e| e.into_inner()).is_empty()
    }

    /// So many slots from now on. Nobody may hold one.
    pub fn set_slots(&self, count: u64) {
        let mut slots = self.slots.lock().unwrap_or_else(|e| e.into_inner());
        slots.resize_with(count as usize, Slot::default);
    }

    /// Makes the slots that nobody holds empty.
    pub fn let_go(&self) {
        self.slots.lock().unwrap_or_else(|e| e.into_inner()).iter_mut().for_each(Slot::clear);
    }

    /// Bytes of the slots that nobody holds.
    pub fn idle_bytes(&self) -> u64 {
        self.slots.lock().unwrap_or_else(|e| e.into_inner()).iter().map(Slot::bytes).sum()
    }

    /// Waits for a free slot.
    pub fn take_slot(&self) -> SlotGuard<'_> {
        let mut slots = self.slots.lock().unwrap_or_else(|e| e.into_inner());
        loop {
            if let Some(slot) = slots.pop() {
                return SlotGuard { device: self, slot };
            }
            slots = self.idle.wait(slots).unwrap_or_else(|e| e.into_inner());
        }
    }
}

/// A slot that goes back when it is dropped, whatever happened.
pub struct SlotGuard<'a> {
    device: &'a Device,
    pub slot: Slot,
}

impl Drop for SlotGuard<'_> {
    fn drop(&mut self) {
        let slot = std::mem::take(&mut self.slot);
        self.device.slots.lock().unwrap_or_else(|e| e.into_inner()).push(slot);
        self.device.idle.notify_one();
    }
}
