// Bind group 0 of every pipeline; `Globals` in globals.rs has the same layout.

struct Globals {
    clip_from_relative: mat4x4<f32>,
    eye_high: vec4<f32>,
    eye_low: vec4<f32>,
    back: vec4<f32>, // w: 1 for orthographic cameras
    up: vec4<f32>,
    key: vec4<f32>,
    unproject: vec4<f32>, // see view_position in occlusion.wgsl
    base_color: vec4<f32>, // linear; w: 1 for vertex colours instead
    section: vec4<f32>, // relative to the eye: kept where dot(xyz, relative) + w >= 0
    section_color: vec4<f32>, // linear; w: 1 if the viewer looks at the cut
    background_low: vec4<f32>, // as the target takes them
    background_high: vec4<f32>,
    viewport: vec4<f32>, // width and height in pixels, and their inverses
    slot_end: u32,
    capacity_slots: u32,
    crease_cosine: f32,
    details: u32,
    level_zero: f32,
    occlusion_strength: f32,
    section_alpha: f32, // 0 if a later pass is to know what is a cut
    morph_now_s: f32,
    morph_share: f32, // of the way that normals still have to go
    unused_0: f32,
    unused_1: f32,
    unused_2: f32,
}

// Bits of `details`.
const DETAIL_WIREFRAME: u32 = 1u;
const DETAIL_LEVELS: u32 = 2u;
const DETAIL_FACING: u32 = 4u;
const DETAIL_FLAT: u32 = 8u;

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

// Octahedral, 16 bits a component; never 0, which is free because -z has four codes.
fn packed_normal(sum: vec3<f32>) -> u32 {
    let n = direction(sum);
    if dot(n, n) == 0.0 {
        return 0u;
    }
    let flat_part = n.xy / (abs(n.x) + abs(n.y) + abs(n.z));
    let signs = select(vec2(-1.0), vec2(1.0), flat_part >= vec2(0.0));
    let e = select(flat_part, (1.0 - abs(flat_part.yx)) * signs, n.z < 0.0);
    let code = pack2x16unorm(e * 0.5 + 0.5);
    return select(code, 0xffffffffu, code == 0u);
}

fn unpacked_normal(code: u32) -> vec3<f32> {
    let e = unpack2x16unorm(code) * 2.0 - 1.0;
    var n = vec3(e, 1.0 - abs(e.x) - abs(e.y));
    let fold = max(-n.z, 0.0);
    n = vec3(n.xy - select(vec2(-fold), vec2(fold), n.xy >= vec2(0.0)), n.z);
    return normalize(n);
}

fn srgb_decoded(c: vec3<f32>) -> vec3<f32> {
    return select(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, c <= vec3(0.04045));
}

fn srgb_encoded(c: vec3<f32>) -> vec3<f32> {
    return select(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, c * 12.92, c <= vec3(0.0031308));
}
