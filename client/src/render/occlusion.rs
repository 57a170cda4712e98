//! Ambient occlusion: darkens the crevices of an image that has been drawn, from its depth.
//!
//! Three passes over the image, of which two at half its size. Its cost depends on the size of the image alone.

use wgpu::{BindGroup, BindGroupLayout, CommandEncoder, Device, ShaderStages, TextureFormat, TextureView};

use super::pipeline::{OCCLUSION_SHADER, shader};
use super::target::Canvas;

/// Of what is visible from each point: eight bits are plenty, since the image has no more.
const VISIBILITY_FORMAT: TextureFormat = TextureFormat::R8Unorm;

/// What depends on the device and the target's format alone.
#[derive(Debug)]
pub(super) struct OcclusionPipelines {
    layout: BindGroupLayout,
    visibility: wgpu::RenderPipeline,
    smooth: wgpu::RenderPipeline,
    apply: wgpu::RenderPipeline,
    /// For images with a section plane.
    apply_cut: wgpu::RenderPipeline,
}

/// Textures of one size.
#[derive(Debug)]
pub(super) struct OcclusionBuffers {
    raw: TextureView,
    smoothed: TextureView,
    /// Group 1 of each pass.
    groups: [BindGroup; 3],
}

impl OcclusionPipelines {
    pub(super) fn new(device: &Device, globals: &BindGroupLayout, format: TextureFormat) -> Self {
        let texture = |binding, sample_type, multisampled| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: ShaderStages::FRAGMENT,
            ty: wgpu::BindingType::Texture {
                sample_type,
                view_dimension: wgpu::TextureViewDimension::D2,
                multisampled,
            },
            count: None,
        };
        let float = wgpu::TextureSampleType::Float { filterable: false };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("occlusion"),
            entries: &[
                texture(0, wgpu::TextureSampleType::Depth, true),
                texture(1, float, false),
                texture(2, float, true),
            ],
        });
        let shader = shader(device, "occlusion", OCCLUSION_SHADER);
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("occlusion"),
            bind_group_layouts: &[Some(globals), Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = |fragment: &str, is_cut: bool, target: wgpu::ColorTargetState| {
            let flag = |is_on: bool| f64::from(u8::from(is_on));
            let constants = [("encode_srgb", flag(!target.format.is_srgb())), ("is_cut", flag(is_cut))];
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some(fragment),
                layout: Some(&pipeline_layout),
                vertex: wgpu::VertexState {
                    module: &shader,
                    entry_point: Some("vertex_image"),
                    compilation_options: Default::default(),
                    buffers: &[],
                },
                primitive: Default::default(),
                depth_stencil: None,
                multisample: Default::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &shader,
                    entry_point: Some(fragment),
                    compilation_options: wgpu::PipelineCompilationOptions {
                        constants: &constants,
                        ..Default::default()
                    },
                    targets: &[Some(target)],
                }),
                multiview_mask: None,
                cache: None,
            })
        };
        let factor = wgpu::BlendState {
            color: wgpu::BlendComponent {
                src_factor: wgpu::BlendFactor::Dst,
                dst_factor: wgpu::BlendFactor::Zero,
                operation: wgpu::BlendOperation::Add,
            },
            // The image is opaque, whatever alpha told on the way.
            alpha: wgpu::BlendComponent::REPLACE,
        };
        let onto_image = || wgpu::ColorTargetState { format, blend: Some(factor), write_mask: wgpu::ColorWrites::ALL };
        Self {
            visibility: pipeline("fragment_visibility", false, VISIBILITY_FORMAT.into()),
            smooth: pipeline("fragment_smooth", false, VISIBILITY_FORMAT.into()),
            apply: pipeline("fragment_apply", false, onto_image()),
            apply_cut: pipeline("fragment_apply", true, onto_image()),
            layout,
        }
    }
}

impl OcclusionBuffers {
    /// For images drawn to `canvas`, whose textures can be read.
    pub(super) fn new(device: &Device, pipelines: &OcclusionPipelines, canvas: &Canvas) -> Self {
        let half = |label| {
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d {
                    width: canvas.size[0].div_ceil(2),
                    height: canvas.size[1].div_ceil(2),
                    depth_or_array_layers: 1,
                },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: VISIBILITY_FORMAT,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            });
            texture.create_view(&Default::default())
        };
        let (raw, smoothed) = (half("visibility"), half("smoothed visibility"));
        let group = |visibilities: &TextureView| {
            let entry =
                |binding, view| wgpu::BindGroupEntry { binding, resource: wgpu::BindingResource::TextureView(view) };
            device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("occlusion"),
                layout: &pipelines.layout,
                entries: &[entry(0, &canvas.depth), entry(1, visibilities), entry(2, &canvas.color)],
            })
        };
        // The first pass writes `raw` and reads the other one's binding without using it.
        let groups = [group(&smoothed), group(&raw), group(&smoothed)];
        Self { raw, smoothed, groups }
    }

    /// Records the passes that darken `target`, which `canvas` was resolved to.
    pub(super) fn encode(
        &self,
        encoder: &mut CommandEncoder,
        pipelines: &OcclusionPipelines,
        globals: &BindGroup,
        target: &TextureView,
        is_cut: bool,
    ) {
        let apply = if is_cut { &pipelines.apply_cut } else { &pipelines.apply };
        let passes = [(&pipelines.visibility, &self.raw), (&pipelines.smooth, &self.smoothed), (apply, target)];
        for ((pipeline, view), group) in passes.into_iter().zip(&self.groups) {
            let is_image = std::ptr::eq(view, target);
            let load = if is_image { wgpu::LoadOp::Load } else { wgpu::LoadOp::Clear(wgpu::Color::WHITE) };
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("occlusion"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
                })],
                depth_stencil_attachment: None,
                timestamp_writes: None,
                occlusion_query_set: None,
                multiview_mask: None,
            });
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, globals, &[]);
            pass.set_bind_group(1, group, &[]);
            pass.draw(0..3, 0..1);
        }
    }
}
