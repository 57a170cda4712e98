//! Shaders are valid WGSL without a GPU to compile them, and what WebGL 2 needs of them is GLSL for it.

#![cfg(feature = "render")]

use lodestream_client::render::pipeline::{
    MESH_SHADER, MORPH_SHADER, NORMALS_SHADER, OCCLUSION_SHADER, SCENERY_SHADER,
};
use naga::ShaderStage::{self, Fragment, Vertex};
use naga::back::{glsl, pipeline_constants};
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};

fn parsed(name: &str, source: &str) -> (naga::Module, ModuleInfo) {
    let module =
        naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
    let info = Validator::new(ValidationFlags::all(), Capabilities::default())
        .validate(&module)
        .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
    (module, info)
}

#[test]
fn shaders_are_valid() {
    for (name, source) in [
        ("mesh", MESH_SHADER),
        ("morph", MORPH_SHADER),
        ("normals", NORMALS_SHADER),
        ("occlusion", OCCLUSION_SHADER),
        ("scenery", SCENERY_SHADER),
    ] {
        parsed(name, source);
    }
}

#[test]
fn what_webgl_draws_with_is_glsl_for_it() {
    let mesh = [(Vertex, "vertex_indexed"), (Fragment, "fragment_flat"), (Fragment, "fragment_flat_discard")];
    let scenery = [
        (Vertex, "vertex_background"),
        (Fragment, "fragment_background"),
        (Vertex, "vertex_line"),
        (Fragment, "fragment_line"),
    ];
    for (source, entry_points) in [(MESH_SHADER, &mesh[..]), (SCENERY_SHADER, &scenery[..])] {
        let (module, info) = parsed("webgl", source);
        for &(shader_stage, name) in entry_points {
            translate(&module, &info, shader_stage, name);
        }
    }
}

fn translate(module: &naga::Module, info: &ModuleInfo, shader_stage: ShaderStage, name: &str) {
    let entry_point = Some((shader_stage, name));
    let (module, info) = pipeline_constants::process_overrides(module, info, entry_point, &Default::default())
        .unwrap_or_else(|e| panic!("{name}: {e}"));
    let options = glsl::Options { version: glsl::Version::new_gles(300), ..Default::default() };
    let pipeline = glsl::PipelineOptions { shader_stage, entry_point: name.into(), multiview: None };
    let mut text = String::new();
    glsl::Writer::new(&mut text, &module, &info, &options, &pipeline, Default::default())
        .and_then(|mut writer| writer.write())
        .unwrap_or_else(|e| panic!("{name}: {e}"));
    assert!(text.starts_with("#version 300 es"), "{name}");
}
