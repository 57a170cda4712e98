//! Instance, adapter, device.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::RenderError;

/// What adapters are looked for: the native ones; WebGPU in browsers, WebGL 2 in the bundle that is built for it.
const BACKENDS: wgpu::Backends = if cfg!(not(target_arch = "wasm32")) {
    wgpu::Backends::PRIMARY
} else if cfg!(feature = "webgl") {
    wgpu::Backends::GL
} else {
    wgpu::Backends::BROWSER_WEBGPU
};

/// How to choose an adapter.
#[derive(Clone, Debug, Default)]
pub struct GpuOptions {
    /// Part of the adapter's name, any case. `None` takes the fastest kind there is. Browsers choose themselves.
    pub adapter_name: Option<String>,
    /// Takes no more of the device than WebGL 2 has, to see what is drawn there.
    pub as_webgl: bool,
}

impl GpuOptions {
    /// The adapter that `LODESTREAM_ADAPTER` names, if it is set.
    pub fn from_env() -> Self {
        let adapter_name = std::env::var("LODESTREAM_ADAPTER").ok().filter(|name| !name.is_empty());
        Self { adapter_name, ..Self::default() }
    }
}

/// A device and where it came from.
#[derive(Clone, Debug)]
pub struct Gpu {
    /// What surfaces are made from.
    pub instance: wgpu::Instance,
    /// What the device runs on.
    pub adapter: wgpu::Adapter,
    /// Makes resources.
    pub device: wgpu::Device,
    /// Takes commands.
    pub queue: wgpu::Queue,
    is_lost: Arc<AtomicBool>,
}

impl Gpu {
    /// An instance for surfaces or images. Validation layers only where wgpu's environment variables ask for them.
    pub fn instance() -> wgpu::Instance {
        let descriptor = wgpu::InstanceDescriptor {
            flags: wgpu::InstanceFlags::empty().with_env(),
            backends: BACKENDS,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        };
        wgpu::Instance::new(descriptor)
    }

    /// A device that can present to `surface`, or one for images if there is none: a real GPU first, a software
    /// rasteriser if there is no other.
    ///
    /// # Errors
    /// [`RenderError::NoAdapter`], [`RenderError::NoSuchAdapter`], [`RenderError::NoDevice`].
    pub async fn new(
        instance: wgpu::Instance,
        surface: Option<&wgpu::Surface<'_>>,
        options: &GpuOptions,
    ) -> Result<Self, RenderError> {
        let adapter = choose(&instance, surface, options).await?;
        let (device, queue) = adapter
            .request_device(&wgpu::DeviceDescriptor {
                label: Some("lodestream"),
                required_features: wgpu::Features::empty(),
                required_limits: limits(&adapter.limits(), options.as_webgl),
                ..Default::default()
            })
            .await
            .map_err(|source| RenderError::NoDevice { adapter: adapter.get_info().name, source })?;
        let is_lost = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&is_lost);
        device.set_device_lost_callback(move |_, _| flag.store(true, Ordering::Relaxed));
        Ok(Self { instance, adapter, device, queue, is_lost })
    }

    /// A device for images, waited for.
    ///
    /// # Errors
    /// See [`Gpu::new`].
    #[cfg(not(target_arch = "wasm32"))]
    pub fn offscreen(options: &GpuOptions) -> Result<Self, RenderError> {
        pollster::block_on(Self::new(Self::instance(), None, options))
    }

    /// Whether the device is gone: the driver was reset, the card was pulled, the browser took it away. Nothing that was made with it is
    /// of use any more; whoever drew with it makes another one and uploads the replica anew.
    pub fn is_lost(&self) -> bool {
        self.is_lost.load(Ordering::Relaxed)
    }

    /// Adapter and backend, for people: `llvmpipe (LLVM 15.0.6, 256 bits), Vulkan, software`.
    pub fn describe(&self) -> String {
        let info = self.adapter.get_info();
        let software = if info.device_type == wgpu::DeviceType::Cpu { ", software" } else { "" };
        format!("{}, {:?}{software}", info.name, info.backend)
    }
}

/// The same few capabilities everywhere, so that what draws here draws elsewhere; only sizes follow the adapter.
fn limits(adapter: &wgpu::Limits, as_webgl: bool) -> wgpu::Limits {
    let base = if as_webgl { wgpu::Limits::downlevel_webgl2_defaults() } else { wgpu::Limits::downlevel_defaults() };
    let max_storage_buffer_binding_size = if as_webgl { 0 } else { adapter.max_storage_buffer_binding_size };
    wgpu::Limits {
        max_texture_dimension_2d: adapter.max_texture_dimension_2d,
        max_buffer_size: adapter.max_buffer_size,
        max_storage_buffer_binding_size,
        ..base
    }
    .or_worse_values_from(adapter)
}

#[cfg(not(target_arch = "wasm32"))]
async fn choose(
    instance: &wgpu::Instance,
    surface: Option<&wgpu::Surface<'_>>,
    options: &GpuOptions,
) -> Result<wgpu::Adapter, RenderError> {
    let mut adapters = instance.enumerate_adapters(BACKENDS).await;
    adapters.retain(|adapter| surface.is_none_or(|surface| adapter.is_surface_supported(surface)));
    if adapters.is_empty() {
        return Err(RenderError::NoAdapter);
    }
    if let Some(wanted) = &options.adapter_name {
        let available = || adapters.iter().map(|a| a.get_info().name).collect::<Vec<_>>().join(", ");
        let missing = RenderError::NoSuchAdapter { wanted: wanted.clone(), available: available() };
        let matches = |a: &wgpu::Adapter| a.get_info().name.to_lowercase().contains(&wanted.to_lowercase());
        return adapters.into_iter().find(matches).ok_or(missing);
    }
    let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    };
    // The first of the best kind: sorting is stable.
    adapters.sort_by_key(rank);
    adapters.into_iter().next().ok_or(RenderError::NoAdapter)
}

#[cfg(target_arch = "wasm32")]
async fn choose(
    instance: &wgpu::Instance,
    surface: Option<&wgpu::Surface<'_>>,
    _: &GpuOptions,
) -> Result<wgpu::Adapter, RenderError> {
    let options = wgpu::RequestAdapterOptions {
        power_preference: wgpu::PowerPreference::HighPerformance,
        compatible_surface: surface,
        ..Default::default()
    };
    instance.request_adapter(&options).await.map_err(|_| RenderError::NoAdapter)
}
