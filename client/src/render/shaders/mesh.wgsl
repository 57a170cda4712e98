// The mesh, flat or smooth. The formula is documented at RenderOptions in options.rs.

// Whether the target does not encode sRGB by itself.
override encode_srgb: bool = false;

struct Surface {
    @builtin(position) clip: vec4<f32>,
    // From the eye in lattice steps. Not at the centroid: derivatives need a plain grid of samples.
    @location(0) relative: vec3<f32>,
    // At the centroid: values interpolated outside of a sliver are nonsense.
    @location(1) @interpolate(perspective, centroid) color: vec3<f32>,
    @location(2) @interpolate(perspective, centroid) normal: vec3<f32>,
}

fn srgb_decoded(c: vec3<f32>) -> vec3<f32> {
    return select(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, c <= vec3(0.04045));
}

fn srgb_encoded(c: vec3<f32>) -> vec3<f32> {
    return select(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, c * 12.92, c <= vec3(0.0031308));
}

fn surface(position: vec3<f32>, color: vec3<f32>, normal: vec3<f32>) -> Surface {
    var out: Surface;
    out.relative = (position - globals.eye_high.xyz) - globals.eye_low.xyz;
    out.clip = globals.clip_from_relative * vec4(out.relative, 1.0);
    out.color = select(globals.base_color.rgb, srgb_decoded(color), globals.base_color.w > 0.0);
    out.normal = normal;
    return out;
}

// Flat: indexed, normals from the derivatives of the position. Needs nothing but vertex attributes.

@vertex
fn vertex_flat(@location(0) position: vec3<f32>, @location(1) color: vec4<f32>) -> Surface {
    return surface(position, color.rgb, vec3(0.0));
}

// Smooth: not indexed, one invocation per corner, because a vertex has several normals where creases meet.

@group(1) @binding(0) var<storage, read> vertices: array<Vertex>;
@group(1) @binding(1) var<storage, read> indices: array<u32>;
// By corner: octahedral normals as normals.wgsl writes them, or 0 for "that of the face".
@group(1) @binding(2) var<storage, read> corner_normals: array<u32>;

fn unpacked_normal(code: u32) -> vec3<f32> {
    let e = unpack2x16unorm(code) * 2.0 - 1.0;
    var n = vec3(e, 1.0 - abs(e.x) - abs(e.y));
    let fold = max(-n.z, 0.0);
    n = vec3(n.xy - select(vec2(-fold), vec2(fold), n.xy >= vec2(0.0)), n.z);
    return normalize(n);
}

@vertex
fn vertex_smooth(@builtin(vertex_index) corner: u32) -> Surface {
    let vertex = vertices[indices[corner]];
    let code = corner_normals[corner];
    var normal: vec3<f32>;
    if code == 0u {
        let first = corner - corner % 3u;
        let a = vertices[indices[first]].position;
        normal = direction(cross(vertices[indices[first + 1u]].position - a, vertices[indices[first + 2u]].position - a));
    } else {
        normal = unpacked_normal(code);
    }
    return surface(vertex.position, unpack4x8unorm(vertex.color).rgb, normal);
}

fn toward_viewer(relative: vec3<f32>) -> vec3<f32> {
    if globals.back.w > 0.0 {
        return globals.back.xyz;
    }
    return direction(-relative);
}

// Sky above, half as bright ground below, and a key light from over the viewer's shoulder.
fn light(n: vec3<f32>) -> f32 {
    return 0.25 * (0.75 + 0.25 * dot(n, globals.up.xyz)) + 0.75 * max(dot(n, globals.key.xyz), 0.0);
}

fn shaded(color: vec3<f32>, n: vec3<f32>) -> vec4<f32> {
    let linear = color * light(n);
    return vec4(select(linear, srgb_encoded(linear), encode_srgb), 1.0);
}

@fragment
fn fragment_flat(in: Surface) -> @location(0) vec4<f32> {
    let viewer = toward_viewer(in.relative);
    var n = direction(cross(direction(dpdx(in.relative)), direction(dpdy(in.relative))));
    if dot(n, n) == 0.0 {
        n = viewer;
    }
    return shaded(in.color, select(n, -n, dot(n, viewer) < 0.0));
}

@fragment
fn fragment_smooth(in: Surface, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
    let viewer = toward_viewer(in.relative);
    var n = direction(select(-in.normal, in.normal, is_front));
    var facing = dot(n, viewer);
    if facing < -0.5 {
        // No interpolation does that to a sound face: this one is a sliver or a fold that faces the wrong way, and its
        // neighbours know better.
        n = -n;
        facing = -facing;
    }
    if facing < 0.0 {
        // The shading normal tips over at silhouettes before the face does: bend it back instead of turning it over.
        n = direction(n - viewer * facing);
    }
    if dot(n, n) == 0.0 {
        n = viewer;
    }
    return shaded(in.color, n);
}
