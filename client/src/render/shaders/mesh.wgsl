// The mesh, flat or smooth. The formula is documented at RenderOptions in options.rs.

// Whether the target does not encode sRGB by itself.
override encode_srgb: bool = false;
// Whether `globals.details` has anything to say. Off, none of it costs anything.
override has_details: bool = false;

struct Surface {
    @builtin(position) clip: vec4<f32>,
    // From the eye in lattice steps. Not at the centroid: derivatives need a plain grid of samples.
    @location(0) relative: vec3<f32>,
    // At the centroid: values interpolated outside of a sliver are nonsense.
    @location(1) @interpolate(perspective, centroid) color: vec3<f32>,
    @location(2) @interpolate(perspective, centroid) normal: vec3<f32>,
    // Two of the face's barycentric coordinates, for its edges.
    @location(3) barycentric: vec2<f32>,
    // Of refinement: halvings from the extent of the model to the edges of this face.
    @location(4) @interpolate(flat, either) level: f32,
}

fn surface(position: vec3<f32>, color: vec3<f32>, normal: vec3<f32>) -> Surface {
    var out: Surface;
    out.relative = (position - globals.eye_high.xyz) - globals.eye_low.xyz;
    out.clip = globals.clip_from_relative * vec4(out.relative, 1.0);
    out.color = select(globals.base_color.rgb, srgb_decoded(color), globals.base_color.w > 0.0);
    out.normal = normal;
    return out;
}

// By vertex: indexed, needs nothing but vertex attributes. Flat only.

@vertex
fn vertex_indexed(@location(0) position: vec3<f32>, @location(1) color: vec4<f32>) -> Surface {
    return surface(position, color.rgb, vec3(0.0));
}

// By corner: not indexed, because a vertex has several normals where creases meet and a corner knows its face.

@group(1) @binding(0) var<storage, read> vertices: array<Vertex>;
@group(1) @binding(1) var<storage, read> indices: array<u32>;
// By corner: octahedral normals as normals.wgsl writes them, or 0 for "that of the face".
@group(1) @binding(2) var<storage, read> corner_normals: array<u32>;

// Twice the area of the face as a vector.
fn area_vector(first: u32) -> vec3<f32> {
    let a = vertices[indices[first]].position;
    return cross(vertices[indices[first + 1u]].position - a, vertices[indices[first + 2u]].position - a);
}

fn corner_surface(corner: u32, normal: vec3<f32>) -> Surface {
    let vertex = vertices[indices[corner]];
    var out = surface(vertex.position, unpack4x8unorm(vertex.color).rgb, normal);
    if has_details {
        let k = corner % 3u;
        out.barycentric = vec2(select(0.0, 1.0, k == 0u), select(0.0, 1.0, k == 1u));
        if (globals.details & DETAIL_LEVELS) != 0u {
            // The legs of a right isosceles triangle of this area.
            out.level = globals.level_zero - 0.5 * log2(max(length(area_vector(corner - k)), 1e-6));
        }
    }
    return out;
}

@vertex
fn vertex_flat(@builtin(vertex_index) corner: u32) -> Surface {
    return corner_surface(corner, vec3(0.0));
}

@vertex
fn vertex_smooth(@builtin(vertex_index) corner: u32) -> Surface {
    let code = corner_normals[corner];
    if code == 0u {
        return corner_surface(corner, direction(area_vector(corner - corner % 3u)));
    }
    return corner_surface(corner, unpacked_normal(code));
}

fn toward_viewer(relative: vec3<f32>) -> vec3<f32> {
    if globals.back.w > 0.0 {
        return globals.back.xyz;
    }
    return direction(-relative);
}

// Sky above, half as bright ground below, and the key light.
fn light(n: vec3<f32>) -> f32 {
    return 0.25 * (0.75 + 0.25 * dot(n, globals.up.xyz)) + 0.75 * max(dot(n, globals.key.xyz), 0.0);
}

// The dull twin of this ramp is `level_color` in options.rs.
fn level_color(level: f32) -> vec3<f32> {
    let ramp = array(
        vec3(0.05, 0.08, 0.45),
        vec3(0.04, 0.35, 0.80),
        vec3(0.06, 0.60, 0.35),
        vec3(0.75, 0.75, 0.08),
        vec3(0.90, 0.35, 0.04),
        vec3(0.60, 0.04, 0.05),
    );
    let at = clamp((level - 2.0) / 2.0, 0.0, 5.0);
    let below = u32(min(floor(at), 4.0));
    return mix(ramp[below], ramp[below + 1u], at - f32(below));
}

const BACK_TINT: vec3<f32> = vec3(0.70, 0.10, 0.06);
const WIRE_COLOR: vec3<f32> = vec3(0.010, 0.012, 0.018);
// In pixels of a face's height over an edge: from where on edges are drawn in full.
const WIRE_SPARSE_PX: f32 = 7.0;

// Coverage of a pixel by lines one pixel wide along the face's edges: each face draws its half. Where faces are as small as
// lines are wide, lines fade instead of turning everything dark.
fn wire_coverage(barycentric: vec2<f32>) -> f32 {
    let b = vec3(barycentric, 1.0 - barycentric.x - barycentric.y);
    let dx = dpdx(b);
    let dy = dpdy(b);
    let slope = max(sqrt(dx * dx + dy * dy), vec3(1e-12));
    let distance_px = abs(b) / slope;
    let height_px = 1.0 / slope;
    let fade = clamp(min(height_px.x, min(height_px.y, height_px.z)) / WIRE_SPARSE_PX, 0.15, 1.0);
    let coverage = clamp(vec3(1.0) - distance_px, vec3(0.0), vec3(1.0));
    return 0.85 * fade * max(coverage.x, max(coverage.y, coverage.z));
}

fn shaded(in: Surface, n: vec3<f32>, is_front: bool) -> vec4<f32> {
    var color = in.color;
    var wire = 0.0;
    if has_details {
        if (globals.details & DETAIL_LEVELS) != 0u {
            color = level_color(in.level);
        }
        if (globals.details & DETAIL_FACING) != 0u && !is_front {
            color = BACK_TINT;
        }
        if (globals.details & DETAIL_WIREFRAME) != 0u {
            wire = wire_coverage(in.barycentric);
        }
    }
    return encoded(mix(color * light(n), WIRE_COLOR, wire));
}

fn encoded(linear: vec3<f32>) -> vec4<f32> {
    return vec4(select(linear, srgb_encoded(linear), encode_srgb), 1.0);
}

fn flat_color(in: Surface, is_front: bool) -> vec4<f32> {
    let viewer = toward_viewer(in.relative);
    var n = direction(cross(direction(dpdx(in.relative)), direction(dpdy(in.relative))));
    if dot(n, n) == 0.0 {
        n = viewer;
    }
    return shaded(in, select(n, -n, dot(n, viewer) < 0.0), is_front);
}

fn smooth_color(in: Surface, is_front: bool) -> vec4<f32> {
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
    return shaded(in, n, is_front);
}

@fragment
fn fragment_flat(in: Surface, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
    return flat_color(in, is_front);
}

@fragment
fn fragment_smooth(in: Surface, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
    return smooth_color(in, is_front);
}

// With a section plane: what lies before it is cut away, sample by sample. Where the viewer looks into the solid, the nearest
// surface behind the plane shows its back: that pixel is drawn as the cut itself, in one colour.

struct Cut {
    @location(0) color: vec4<f32>,
    @builtin(sample_mask) samples: u32,
}

fn cut_color(is_front: bool, color: vec4<f32>) -> vec4<f32> {
    if globals.section_color.w > 0.0 && !is_front {
        return vec4(encoded(globals.section_color.rgb).rgb, globals.section_alpha);
    }
    return color;
}

fn kept(relative: vec3<f32>) -> f32 {
    return dot(globals.section.xyz, relative) + globals.section.w;
}

fn cut(in: Surface, is_front: bool, color: vec4<f32>) -> Cut {
    let inside = kept(in.relative);
    let slope = vec2(dpdx(inside), dpdy(inside));
    // Where WebGPU puts the four samples of a pixel, from its middle.
    let samples = vec4(
        dot(slope, vec2(-0.125, -0.375)),
        dot(slope, vec2(0.375, -0.125)),
        dot(slope, vec2(-0.375, 0.125)),
        dot(slope, vec2(0.125, 0.375)),
    );
    let is_kept = vec4(inside) + samples >= vec4(0.0);
    return Cut(cut_color(is_front, color), dot(select(vec4<u32>(), vec4(1u, 2u, 4u, 8u), is_kept), vec4(1u)));
}

@fragment
fn fragment_flat_cut(in: Surface, @builtin(front_facing) is_front: bool) -> Cut {
    return cut(in, is_front, flat_color(in, is_front));
}

@fragment
fn fragment_smooth_cut(in: Surface, @builtin(front_facing) is_front: bool) -> Cut {
    return cut(in, is_front, smooth_color(in, is_front));
}

// WebGL has no masks: whole pixels there.
@fragment
fn fragment_flat_discard(in: Surface, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
    let color = flat_color(in, is_front);
    if kept(in.relative) < 0.0 {
        discard;
    }
    return cut_color(is_front, color);
}

// Ghosts of faces that collapses have taken away: as they were, fading over what is there now.

@vertex
fn vertex_ghost(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) color: vec4<f32>,
    @location(3) begin_s: f32,
    @location(4) rate_per_s: f32,
) -> GhostSurface {
    let s = surface(position, color.rgb, normal);
    let t = clamp((globals.morph_now_s - begin_s) * rate_per_s, 0.0, 1.0);
    return GhostSurface(s.clip, s.relative, s.color, s.normal, 1.0 - t);
}

struct GhostSurface {
    @builtin(position) clip: vec4<f32>,
    @location(0) relative: vec3<f32>,
    @location(1) @interpolate(perspective, centroid) color: vec3<f32>,
    @location(2) @interpolate(perspective, centroid) normal: vec3<f32>,
    @location(3) opacity: f32,
}

@fragment
fn fragment_ghost(in: GhostSurface, @builtin(front_facing) is_front: bool) -> @location(0) vec4<f32> {
    let plain = Surface(in.clip, in.relative, in.color, in.normal, vec2(0.0), 0.0);
    let flat_shade = flat_color(plain, is_front);
    let smooth_shade = smooth_color(plain, is_front);
    if kept(in.relative) < 0.0 {
        discard;
    }
    return vec4(select(smooth_shade, flat_shade, (globals.details & DETAIL_FLAT) != 0u).rgb, in.opacity);
}
