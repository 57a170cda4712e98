//! Shaders, bind group layouts and pipelines. Group 0 is the globals, group 1 the mesh.

use std::collections::HashMap;

use wgpu::{BindGroupLayout, Device, ShaderModule, ShaderStages, TextureFormat};

use super::ghosts::GHOST_CORNER_BYTES;
use super::lines::LINE_BYTES;
use super::upload::VERTEX_BYTES;

/// WGSL of the mesh pipelines.
pub const MESH_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/mesh.wgsl"));
/// WGSL of the passes that compute normals.
pub const NORMALS_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/normals.wgsl"));
/// WGSL of background and lines.
pub const SCENERY_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/scenery.wgsl"));
/// WGSL of the passes that darken crevices.
pub const OCCLUSION_SHADER: &str =
    concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/occlusion.wgsl"));
/// WGSL of the pass that says where vertices are shown.
pub const MORPH_SHADER: &str = concat!(include_str!("shaders/globals.wgsl"), include_str!("shaders/morph.wgsl"));

/// Samples per pixel.
pub const SAMPLES: u32 = 4;
/// Reverse-Z needs floats: their precision near 0 makes up for the division.
pub const DEPTH_FORMAT: TextureFormat = TextureFormat::Depth32Float;
/// Invocations per workgroup of the compute passes, as in the shader.
pub const WORKGROUP: u32 = 64;

/// How the mesh gets to the rasteriser.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Geometry {
    /// Indexed by vertex, flat, without details: all that devices without storage buffers can do.
    Indexed,
    /// By corner, flat.
    Flat,
    /// By corner, with the corners' normals.
    Smooth,
}

/// Which of the mesh's pipelines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MeshPipeline {
    /// Vertex stage and normals.
    pub geometry: Geometry,
    /// Wireframe, refinement colours, tinted backs.
    pub has_details: bool,
    /// A section plane.
    pub is_cut: bool,
}

/// Everything that depends on the device and the target's format alone.
#[derive(Debug)]
pub struct Pipelines {
    /// Group 0.
    pub globals: BindGroupLayout,
    /// Absent where the device has too few storage buffers.
    pub corners: Option<CornerPipelines>,
    /// A triangle behind everything.
    pub background: wgpu::RenderPipeline,
    /// Lines that the mesh hides.
    pub hidden_lines: wgpu::RenderPipeline,
    /// Lines in front of the mesh.
    pub lines: wgpu::RenderPipeline,
    /// Faces that fade.
    pub ghosts: wgpu::RenderPipeline,
    mesh_shader: ShaderModule,
    /// Compiled when they are first asked for: most viewers use two or three.
    mesh: HashMap<MeshPipeline, wgpu::RenderPipeline>,
    format: TextureFormat,
}

/// Drawing by corner, and the passes that compute the corners' normals.
#[derive(Debug)]
pub struct CornerPipelines {
    /// Group 1 of drawing: vertices, indices, corner normals.
    pub draw_layout: BindGroupLayout,
    /// Face normals and lists of corners.
    pub link: wgpu::ComputePipeline,
    /// Group 1 of `link`: vertices, indices, links, face normals.
    pub link_layout: BindGroupLayout,
    /// Normals by corner.
    pub corners: wgpu::ComputePipeline,
    /// Group 1 of `corners`: indices (1), links (2), face normals (3), corner normals (4).
    pub corners_layout: BindGroupLayout,
    /// Lets the normals that are shown follow those that were computed.
    pub follow: wgpu::ComputePipeline,
    /// Group 1 of `follow`: corner normals, shown normals.
    pub follow_layout: BindGroupLayout,
}

impl Pipelines {
    /// Compiles for targets of `format`. Targets that do not encode sRGB get it from the shader.
    pub fn new(device: &Device, format: TextureFormat) -> Self {
        let stages = ShaderStages::VERTEX_FRAGMENT | ShaderStages::COMPUTE;
        let globals = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("globals"),
            entries: &[entry(0, stages, wgpu::BufferBindingType::Uniform)],
        });
        let scenery = shader(device, "scenery", SCENERY_SHADER);
        let line_attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3, 2 => Unorm8x4];
        let line_buffer = wgpu::VertexBufferLayout {
            array_stride: LINE_BYTES,
            step_mode: wgpu::VertexStepMode::Instance,
            attributes: &line_attributes,
        };
        let draw = |shape: Shape<'_>| shape.build(device, &scenery, format, &[Some(&globals)]);
        let line = |depth_compare| {
            draw(Shape {
                vertex: "vertex_line",
                fragment: "fragment_line",
                buffers: &[Some(line_buffer.clone())],
                topology: wgpu::PrimitiveTopology::TriangleStrip,
                depth_compare,
                blend: Some(wgpu::BlendState::ALPHA_BLENDING),
                ..Shape::default()
            })
        };
        let mesh_shader = shader(device, "mesh", MESH_SHADER);
        let ghost_attributes =
            wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3, 2 => Unorm8x4, 3 => Float32, 4 => Float32];
        let ghost_shape = Shape {
            vertex: "vertex_ghost",
            fragment: "fragment_ghost",
            buffers: &[Some(wgpu::VertexBufferLayout {
                array_stride: GHOST_CORNER_BYTES,
                step_mode: wgpu::VertexStepMode::Vertex,
                attributes: &ghost_attributes,
            })],
            depth_compare: wgpu::CompareFunction::GreaterEqual,
            // Nearer by a thousandth: what is gone and what is there now lie in each other.
            depth_bias: 1 << 13,
            is_of_mesh: true,
            blend: Some(wgpu::BlendState::ALPHA_BLENDING),
            ..Shape::default()
        };
        Self {
            ghosts: ghost_shape.build(device, &mesh_shader, format, &[Some(&globals)]),
            corners: has_storage(&device.limits()).then(|| CornerPipelines::new(device, &globals)),
            background: draw(Shape {
                vertex: "vertex_background",
                fragment: "fragment_background",
                depth_compare: wgpu::CompareFunction::Always,
                ..Shape::default()
            }),
            hidden_lines: line(wgpu::CompareFunction::Less),
            lines: line(wgpu::CompareFunction::GreaterEqual),
            mesh_shader,
            mesh: HashMap::new(),
            globals,
            format,
        }
    }

    /// The pipeline of this kind, compiled if it is the first time.
    ///
    /// # Panics
    /// If `kind` goes by corner and the device [cannot](Self::corners).
    pub fn mesh(&mut self, device: &Device, kind: MeshPipeline) -> &wgpu::RenderPipeline {
        self.mesh.entry(kind).or_insert_with(|| {
            let attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Unorm8x4];
            let by_vertex = [Some(wgpu::VertexBufferLayout {
                array_stride: VERTEX_BYTES,
                step_mode: wgpu::VertexStepMode::Vertex,
                attributes: &attributes,
            })];
            let by_corner = || Some(&self.corners.as_ref().expect("the device has storage buffers").draw_layout);
            let (vertex, fragment, buffers, group) = match kind.geometry {
                Geometry::Indexed => ("vertex_indexed", "fragment_flat", &by_vertex[..], None),
                Geometry::Flat => ("vertex_flat", "fragment_flat", &[][..], by_corner()),
                Geometry::Smooth => ("vertex_smooth", "fragment_smooth", &[][..], by_corner()),
            };
            let cut = match (kind.is_cut, &self.corners) {
                (false, _) => "",
                (true, Some(_)) => "_cut",
                (true, None) => "_discard",
            };
            let shape = Shape {
                vertex,
                fragment: &format!("{fragment}{cut}"),
                buffers,
                writes_depth: true,
                is_of_mesh: true,
                has_details: kind.has_details,
                ..Shape::default()
            };
            let groups = [Some(&self.globals), group];
            let used = if group.is_some() { 2 } else { 1 };
            shape.build(device, &self.mesh_shader, self.format, &groups[..used])
        })
    }
}

/// Four storage buffers and compute passes: all but WebGL.
pub(super) fn has_storage(limits: &wgpu::Limits) -> bool {
    limits.max_storage_buffers_per_shader_stage >= 4 && limits.max_compute_invocations_per_workgroup >= WORKGROUP
}

impl CornerPipelines {
    fn new(device: &Device, globals: &BindGroupLayout) -> Self {
        let read = wgpu::BufferBindingType::Storage { read_only: true };
        let write = wgpu::BufferBindingType::Storage { read_only: false };
        let draw_layout = layout(device, "corners", ShaderStages::VERTEX, &[(0, read), (1, read), (2, read)]);
        let link_layout = compute_layout(device, "link", &[(0, read), (1, read), (2, write), (3, write)]);
        let corners_layout = compute_layout(device, "corners", &[(1, read), (2, write), (3, write), (4, write)]);
        let follow_layout = compute_layout(device, "follow", &[(0, read), (1, write)]);
        let normals = shader(device, "normals", NORMALS_SHADER);
        let morph = shader(device, "morph", MORPH_SHADER);
        let compute = |module, entry_point, layout: &BindGroupLayout| {
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(entry_point),
                bind_group_layouts: &[Some(globals), Some(layout)],
                immediate_size: 0,
            });
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry_point),
                layout: Some(&layout),
                module,
                entry_point: Some(entry_point),
                compilation_options: Default::default(),
                cache: None,
            })
        };
        Self {
            link: compute(&normals, "link", &link_layout),
            corners: compute(&normals, "smooth_corners", &corners_layout),
            follow: compute(&morph, "follow", &follow_layout),
            follow_layout,
            draw_layout,
            link_layout,
            corners_layout,
        }
    }
}

/// What a draw pipeline does not share with the others.
struct Shape<'a> {
    vertex: &'a str,
    fragment: &'a str,
    buffers: &'a [Option<wgpu::VertexBufferLayout<'a>>],
    topology: wgpu::PrimitiveTopology,
    depth_compare: wgpu::CompareFunction,
    writes_depth: bool,
    blend: Option<wgpu::BlendState>,
    /// In steps of the depth's floats.
    depth_bias: i32,
    is_of_mesh: bool,
    has_details: bool,
}

impl Default for Shape<'_> {
    fn default() -> Self {
        Self {
            vertex: "",
            fragment: "",
            buffers: &[],
            topology: wgpu::PrimitiveTopology::TriangleList,
            depth_compare: wgpu::CompareFunction::Greater,
            writes_depth: false,
            blend: None,
            depth_bias: 0,
            is_of_mesh: false,
            has_details: false,
        }
    }
}

impl Shape<'_> {
    fn build(
        &self,
        device: &Device,
        shader: &ShaderModule,
        format: TextureFormat,
        groups: &[Option<&BindGroupLayout>],
    ) -> wgpu::RenderPipeline {
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(self.vertex),
            bind_group_layouts: groups,
            immediate_size: 0,
        });
        let flag = |is_on: bool| f64::from(u8::from(is_on));
        let constants = [("encode_srgb", flag(!format.is_srgb())), ("has_details", flag(self.has_details))];
        // A constant that the shader does not have is an error: scenery has no details.
        let constants = if self.is_of_mesh { &constants[..] } else { &constants[..1] };
        let compilation_options = wgpu::PipelineCompilationOptions { constants, ..Default::default() };
        device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(self.vertex),
            layout: Some(&layout),
            vertex: wgpu::VertexState {
                module: shader,
                entry_point: Some(self.vertex),
                compilation_options: compilation_options.clone(),
                buffers: self.buffers,
            },
            // Both sides are drawn: the inside of an open scan is lit like its outside.
            primitive: wgpu::PrimitiveState { cull_mode: None, topology: self.topology, ..Default::default() },
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH_FORMAT,
                depth_write_enabled: Some(self.writes_depth),
                depth_compare: Some(self.depth_compare),
                stencil: Default::default(),
                bias: wgpu::DepthBiasState { constant: self.depth_bias, ..Default::default() },
            }),
            multisample: wgpu::MultisampleState { count: SAMPLES, ..Default::default() },
            fragment: Some(wgpu::FragmentState {
                module: shader,
                entry_point: Some(self.fragment),
                compilation_options,
                targets: &[Some(wgpu::ColorTargetState {
                    format,
                    blend: self.blend,
                    write_mask: wgpu::ColorWrites::ALL,
                })],
            }),
            multiview_mask: None,
            cache: None,
        })
    }
}

/// Layout of a group of buffers for compute passes.
pub(super) fn compute_layout(
    device: &Device,
    label: &str,
    bindings: &[(u32, wgpu::BufferBindingType)],
) -> BindGroupLayout {
    layout(device, label, ShaderStages::COMPUTE, bindings)
}

fn layout(
    device: &Device,
    label: &str,
    stage: ShaderStages,
    bindings: &[(u32, wgpu::BufferBindingType)],
) -> BindGroupLayout {
    let entries: Vec<_> = bindings.iter().map(|&(binding, ty)| entry(binding, stage, ty)).collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries })
}

/// A group of whole buffers.
pub(super) fn bind(device: &Device, layout: &BindGroupLayout, bindings: &[(u32, &wgpu::Buffer)]) -> wgpu::BindGroup {
    let entries: Vec<_> = bindings
        .iter()
        .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
        .collect();
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

/// One invocation for each of `elements`, in as many rows of workgroups as that takes.
pub(super) fn dispatch(
    device: &Device,
    pass: &mut wgpu::ComputePass<'_>,
    pipeline: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    elements: u32,
) {
    if elements == 0 {
        return;
    }
    let groups = elements.div_ceil(WORKGROUP);
    let x = groups.min(device.limits().max_compute_workgroups_per_dimension);
    pass.set_pipeline(pipeline);
    pass.set_bind_group(1, group, &[]);
    pass.dispatch_workgroups(x, groups.div_ceil(x), 1);
}

pub(super) fn shader(device: &Device, label: &str, source: &str) -> ShaderModule {
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
