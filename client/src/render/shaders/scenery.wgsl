// What is drawn besides the mesh: the background and lines.

override encode_srgb: bool = false;

struct Backdrop {
    @builtin(position) clip: vec4<f32>,
    @location(0) height: f32, // 0 at the bottom, 1 at the top
}

// One triangle that covers the image.
@vertex
fn vertex_background(@builtin(vertex_index) i: u32) -> Backdrop {
    let at = vec2(f32(i & 1u), f32(i >> 1u)) * 4.0 - 1.0;
    return Backdrop(vec4(at, 0.0, 1.0), 0.5 * at.y + 0.5);
}

@fragment
fn fragment_background(in: Backdrop) -> @location(0) vec4<f32> {
    // Less than half a step of a byte, so that the gradient has no bands.
    let noise = fract(52.9829189 * fract(dot(in.clip.xy, vec2(0.06711056, 0.00583715)))) - 0.5;
    let color = mix(globals.background_low, globals.background_high, clamp(in.height, 0.0, 1.0));
    return vec4(color.rgb + noise * globals.background_high.w, 1.0);
}

struct Line {
    @builtin(position) clip: vec4<f32>,
    @location(0) color: vec4<f32>,
    // Distance from the middle of the line in pixels.
    @location(1) across_px: f32,
}

const HALF_WIDTH_PX: f32 = 0.8;

// One instance per line, four corners each: a band of constant width in pixels. w of the ends is 1.
@vertex
fn vertex_line(
    @builtin(vertex_index) corner: u32,
    @location(0) begin: vec3<f32>,
    @location(1) end: vec3<f32>,
    @location(2) color: vec4<f32>,
) -> Line {
    var a = globals.clip_from_relative * vec4(begin, 1.0);
    var b = globals.clip_from_relative * vec4(end, 1.0);
    // Cut at the near plane (z = w with reversed depth) and in front of it: behind the eye there are no pixels.
    let inside = vec2(a.w - a.z, b.w - b.z);
    if inside.x < 0.0 && inside.y > 0.0 {
        a = mix(a, b, -inside.x / (inside.y - inside.x));
    } else if inside.y < 0.0 && inside.x > 0.0 {
        b = mix(b, a, -inside.y / (inside.x - inside.y));
    }
    var out: Line;
    if max(inside.x, inside.y) <= 0.0 {
        out.clip = vec4(2.0, 2.0, 0.0, 1.0);
        return out;
    }
    let half_size = 0.5 * globals.viewport.xy;
    let along = (b.xy / b.w - a.xy / a.w) * half_size;
    let length_px = length(along);
    let unit = select(vec2(1.0, 0.0), along / length_px, length_px > 1e-6);
    let side = select(-1.0, 1.0, (corner & 1u) != 0u);
    let end_side = select(-1.0, 1.0, corner >= 2u);
    let out_px = (vec2(-unit.y, unit.x) * side + unit * end_side * 0.5) * (HALF_WIDTH_PX + 0.5);
    let middle = select(a, b, corner >= 2u);
    out.clip = vec4(middle.xy + out_px / half_size * middle.w, middle.zw);
    out.color = color;
    out.across_px = side * (HALF_WIDTH_PX + 0.5);
    return out;
}

@fragment
fn fragment_line(in: Line) -> @location(0) vec4<f32> {
    let coverage = clamp(HALF_WIDTH_PX + 0.5 - abs(in.across_px), 0.0, 1.0);
    let linear = srgb_decoded(in.color.rgb);
    return vec4(select(linear, in.color.rgb, encode_srgb), in.color.a * coverage);
}
