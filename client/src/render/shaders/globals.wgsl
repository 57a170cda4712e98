// Bind group 0 of every pipeline; `Globals` in pipeline.rs has the same layout.

struct Globals {
    clip_from_relative: mat4x4<f32>,
    eye_high: vec4<f32>,
    eye_low: vec4<f32>,
    back: vec4<f32>, // w: 1 for orthographic cameras
    up: vec4<f32>,
    key: vec4<f32>,
    base_color: vec4<f32>, // linear; w: 1 for vertex colours instead
    slot_end: u32,
    capacity_slots: u32,
    crease_cosine: f32,
    unused: u32,
}

// 16 bytes, as GpuVertex in upload.rs.
struct Vertex {
    position: vec3<f32>,
    color: u32,
}

@group(0) @binding(0) var<uniform> globals: Globals;

// The unit vector along v, or zero where v has no direction. Scaled first: the square of a small footprint underflows.
fn direction(v: vec3<f32>) -> vec3<f32> {
    let size = max(abs(v.x), max(abs(v.y), abs(v.z)));
    if !(size > 0.0 && size < 1e38) {
        return vec3(0.0);
    }
    return normalize(v / size);
}
