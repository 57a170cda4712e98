//! Shaders, bind group layouts and pipelines. Group 0 is the globals, group 1 the mesh.

use bytemuck::{Pod, Zeroable};
use wgpu::{BindGroupLayout, Device, ShaderStages, TextureFormat};

use super::camera::CameraUniform;
use super::upload::VERTEX_BYTES;

/// WGSL of the mesh pipelines.
pub const MESH_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/mesh.wgsl"));
/// WGSL of the passes that compute normals.
pub const NORMALS_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/normals.wgsl"));

/// Samples per pixel.
pub const SAMPLES: u32 = 4;
/// Reverse-Z needs floats: their precision near 0 makes up for the division.
pub const DEPTH_FORMAT: TextureFormat = TextureFormat::Depth32Float;
/// Invocations per workgroup of the compute passes, as in the shader.
pub const WORKGROUP: u32 = 64;

/// Bind group 0, as in `globals.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Globals {
    /// Camera and light.
    pub camera: CameraUniform,
    /// Linear base colour; `w` is 1 where vertex colours replace it.
    pub base_color: [f32; 4],
    /// One past the last slot.
    pub slot_end: u32,
    /// Slots of the buffers.
    pub capacity_slots: u32,
    /// Cosine of the crease angle.
    pub crease_cosine: f32,
    /// Fills the last 16 bytes.
    pub unused: u32,
}

/// Everything that depends on the device and the target's format alone.
#[derive(Debug)]
pub struct Pipelines {
    /// Group 0.
    pub globals: BindGroupLayout,
    /// Indexed drawing, normals from derivatives.
    pub flat: wgpu::RenderPipeline,
    /// Absent where the device has too few storage buffers.
    pub smooth: Option<SmoothPipelines>,
}

/// Drawing by corner, and the passes that compute the corners' normals.
#[derive(Debug)]
pub struct SmoothPipelines {
    /// Not indexed: six corners per slot.
    pub draw: wgpu::RenderPipeline,
    /// Group 1 of `draw`: vertices, indices, corner normals.
    pub draw_layout: BindGroupLayout,
    /// Face normals and lists of corners.
    pub link: wgpu::ComputePipeline,
    /// Group 1 of `link`: vertices, indices, links, face normals.
    pub link_layout: BindGroupLayout,
    /// Normals by corner.
    pub corners: wgpu::ComputePipeline,
    /// Group 1 of `corners`: indices (1), links (2), face normals (3), corner normals (4).
    pub corners_layout: BindGroupLayout,
}

impl Pipelines {
    /// Compiles for targets of `format`. Targets that do not encode sRGB get it from the shader.
    pub fn new(device: &Device, format: TextureFormat) -> Self {
        let shader = shader(device, "mesh", MESH_SHADER);
        let stages = ShaderStages::VERTEX_FRAGMENT | ShaderStages::COMPUTE;
        let globals = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("globals"),
            entries: &[entry(0, stages, wgpu::BufferBindingType::Uniform)],
        });
        let position_and_color = wgpu::vertex_attr_array![0 => Float32x3, 1 => Unorm8x4];
        let vertices = wgpu::VertexBufferLayout {
            array_stride: VERTEX_BYTES,
            step_mode: wgpu::VertexStepMode::Vertex,
            attributes: &position_and_color,
        };
        let draw = DrawPipeline { device, shader: &shader, format };
        let flat = draw.build("flat", &[Some(&globals)], &[Some(vertices)]);
        let smooth = can_smooth(&device.limits()).then(|| SmoothPipelines::new(&draw, &globals));
        Self { globals, flat, smooth }
    }
}

/// Four storage buffers and compute passes: all but WebGL.
fn can_smooth(limits: &wgpu::Limits) -> bool {
    limits.max_storage_buffers_per_shader_stage >= 4 && limits.max_compute_invocations_per_workgroup >= WORKGROUP
}

impl SmoothPipelines {
    fn new(draw: &DrawPipeline<'_>, globals: &BindGroupLayout) -> Self {
        let device = draw.device;
        let read = wgpu::BufferBindingType::Storage { read_only: true };
        let write = wgpu::BufferBindingType::Storage { read_only: false };
        let layout = |label, stage, bindings: &[(u32, wgpu::BufferBindingType)]| {
            let entries: Vec<_> = bindings.iter().map(|&(binding, ty)| entry(binding, stage, ty)).collect();
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries })
        };
        let draw_layout = layout("smooth", ShaderStages::VERTEX, &[(0, read), (1, read), (2, read)]);
        let link_layout = layout("link", ShaderStages::COMPUTE, &[(0, read), (1, read), (2, write), (3, write)]);
        let corners_layout = layout("corners", ShaderStages::COMPUTE, &[(1, read), (2, write), (3, write), (4, write)]);
        let shader = shader(device, "normals", NORMALS_SHADER);
        let compute = |entry_point, layout: &BindGroupLayout| {
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(entry_point),
                bind_group_layouts: &[Some(globals), Some(layout)],
                immediate_size: 0,
            });
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry_point),
                layout: Some(&layout),
                module: &shader,
                entry_point: Some(entry_point),
                compilation_options: Default::default(),
                cache: None,
            })
        };
        Self {
            draw: draw.build("smooth", &[Some(globals), Some(&draw_layout)], &[]),
            link: compute("link", &link_layout),
            corners: compute("smooth_corners", &corners_layout),
            draw_layout,
            link_layout,
            corners_layout,
        }
    }
}

/// What the draw pipelines have in common.
struct DrawPipeline<'a> {
    device: &'a Device,
    shader: &'a wgpu::ShaderModule,
    format: TextureFormat,
}

impl DrawPipeline<'_> {
    fn build(
        &self,
        kind: &str,
        groups: &[Option<&BindGroupLayout>],
        buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
    ) -> wgpu::RenderPipeline {
        let layout = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(kind),
            bind_group_layouts: groups,
            immediate_size: 0,
        });
        let encode = [("encode_srgb", f64::from(u8::from(!self.format.is_srgb())))];
        self.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(kind),
            layout: Some(&layout),
            vertex: wgpu::VertexState {
                module: self.shader,
                entry_point: Some(&format!("vertex_{kind}")),
                compilation_options: Default::default(),
                buffers,
            },
            // Both sides are drawn: the inside of an open scan is lit like its outside.
            primitive: wgpu::PrimitiveState { cull_mode: None, ..Default::default() },
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH_FORMAT,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Greater),
                stencil: Default::default(),
                bias: Default::default(),
            }),
            multisample: wgpu::MultisampleState { count: SAMPLES, ..Default::default() },
            fragment: Some(wgpu::FragmentState {
                module: self.shader,
                entry_point: Some(&format!("fragment_{kind}")),
                compilation_options: wgpu::PipelineCompilationOptions { constants: &encode, ..Default::default() },
                targets: &[Some(self.format.into())],
            }),
            multiview_mask: None,
            cache: None,
        })
    }
}

fn shader(device: &Device, label: &str, source: &str) -> wgpu::ShaderModule {
    device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(label),
        source: wgpu::ShaderSource::Wgsl(source.into()),
    })
}

fn entry(binding: u32, visibility: ShaderStages, ty: wgpu::BufferBindingType) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    }
}
