//! Shaders are valid WGSL without a GPU to compile them.

#![cfg(feature = "render")]

use lodestream_client::render::pipeline::{MESH_SHADER, NORMALS_SHADER, SCENERY_SHADER};

#[test]
fn shaders_are_valid() {
    for (name, source) in [("mesh", MESH_SHADER), ("normals", NORMALS_SHADER), ("scenery", SCENERY_SHADER)] {
        let module =
            naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
        let capabilities = naga::valid::Capabilities::default();
        let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
        validator.validate(&module).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(source)));
    }
}
