// How much of the sky above each point its surroundings hide, from the depth of the image alone: ground-truth ambient
// occlusion (Jimenez, Wu, Pesce, Jarabo 2016, "Practical realtime strategies for accurate indirect occlusion"), at half the
// size of the image, smoothed along surfaces, and multiplied onto the image sample by sample.
//
// Around a point, slices through the viewer's ray are cut in a few directions; in each, the highest horizons on both sides
// are looked for, and what they leave free is integrated in closed form.

@group(1) @binding(0) var depths: texture_depth_multisampled_2d;
// At half the size: 1 where nothing is hidden.
@group(1) @binding(1) var visibilities: texture_2d<f32>;
// The image before it was resolved; its alpha is 0 where a cut is, which has a depth that is not its own.
@group(1) @binding(2) var colors: texture_multisampled_2d<f32>;

// Whether the target does not encode sRGB by itself.
override encode_srgb: bool = false;
// Whether there may be cuts.
override is_cut: bool = false;

const PI: f32 = 3.14159265;
const SLICES: u32 = 3u;
const STEPS: u32 = 5u;
// How far horizons are looked for, as a share of the height of the image: the cue is as strong near as far.
const RADIUS: f32 = 0.1;
// Exponent of what is visible: shapes read better with more contrast than the sky gives them.
const CONTRAST: f32 = 3.0;

@vertex
fn vertex_image(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {
    return vec4(vec2(f32(i & 1u), f32(i >> 1u)) * 4.0 - 1.0, 0.0, 1.0);
}

// Distance ahead of the eye, in lattice steps. `depth` is not 0.
fn ahead(depth: f32) -> f32 {
    if globals.back.w > 0.0 {
        return globals.unproject.w - depth * globals.unproject.z;
    }
    return globals.unproject.z / depth;
}

// In camera coordinates: x right, y up, z towards the viewer. `at` in pixels of the image.
fn view_position(at: vec2<f32>, depth: f32) -> vec3<f32> {
    let ndc = (at * globals.viewport.zw * 2.0 - 1.0) * vec2(1.0, -1.0);
    let distance = ahead(depth);
    let scale = select(distance, 1.0, globals.back.w > 0.0);
    return vec3(ndc * globals.unproject.xy * scale, -distance);
}

fn depth_at(pixel: vec2<i32>) -> f32 {
    return textureLoad(depths, clamp(pixel, vec2(0), vec2<i32>(globals.viewport.xy) - 1), 0);
}

fn position_at(pixel: vec2<i32>) -> vec4<f32> {
    let depth = depth_at(pixel);
    return vec4(view_position(vec2<f32>(pixel) + 0.5, max(depth, 1e-30)), depth);
}

// Along an axis of the image, the difference to the neighbour that is more likely on the same surface.
fn tangent(center: vec3<f32>, before: vec4<f32>, after: vec4<f32>) -> vec3<f32> {
    let behind = select(center - before.xyz, vec3(1e30), before.w <= 0.0);
    let beyond = select(after.xyz - center, vec3(1e30), after.w <= 0.0);
    return select(beyond, behind, abs(behind.z) < abs(beyond.z));
}

fn normal_at(pixel: vec2<i32>, center: vec3<f32>) -> vec3<f32> {
    let x = tangent(center, position_at(pixel - vec2(1, 0)), position_at(pixel + vec2(1, 0)));
    let y = tangent(center, position_at(pixel + vec2(0, 1)), position_at(pixel - vec2(0, 1)));
    return direction(cross(direction(x), direction(y)));
}

// Angles that a tile of four by four pixels shares among its pixels, so that smoothing over a tile sees sixteen times as
// many directions.
fn tile_noise(half_pixel: vec2<i32>) -> vec2<f32> {
    let order = array(0.0, 8.0, 2.0, 10.0, 12.0, 4.0, 14.0, 6.0, 3.0, 11.0, 1.0, 9.0, 15.0, 7.0, 13.0, 5.0);
    let x = u32(half_pixel.x) & 3u;
    let y = u32(half_pixel.y) & 3u;
    return (vec2(order[y * 4u + x], order[x * 4u + (3u - y)]) + 0.5) / 16.0;
}

fn horizon(
    center: vec3<f32>,
    viewer: vec3<f32>,
    pixel: vec2<i32>,
    step_px: vec2<f32>,
    radius: f32,
    lowest: f32,
) -> f32 {
    let at = position_at(pixel + vec2<i32>(round(step_px)));
    let delta = at.xyz - center;
    let distance = length(delta);
    if at.w <= 0.0 || distance < 1e-6 * radius {
        return lowest;
    }
    // What is farther away hides less and less: no dark halos around what lies in front.
    let weight = clamp(2.0 - 2.0 * distance / radius, 0.0, 1.0);
    return mix(lowest, dot(delta / distance, viewer), weight);
}

// What the horizon leaves of a slice, from the middle to `angle`, for a normal at angle `n`.
fn arc(angle: f32, n: f32, cos_n: f32, sin_n: f32) -> f32 {
    return 0.25 * (cos_n + 2.0 * angle * sin_n - cos(2.0 * angle - n));
}

@fragment
fn fragment_visibility(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let half_pixel = vec2<i32>(at.xy);
    let pixel = 2 * half_pixel;
    let own = position_at(pixel);
    if own.w <= 0.0 {
        return vec4(1.0);
    }
    let center = own.xyz;
    let viewer = select(direction(-center), vec3(0.0, 0.0, 1.0), globals.back.w > 0.0);
    let normal = normal_at(pixel, center);
    if dot(normal, normal) == 0.0 {
        return vec4(1.0);
    }
    let radius_px = RADIUS * globals.viewport.y;
    let per_pixel = globals.unproject.y * select(-center.z, 1.0, globals.back.w > 0.0) * 2.0 * globals.viewport.w;
    let radius = radius_px * per_pixel;
    let noise = tile_noise(half_pixel);
    var visible = 0.0;
    for (var slice = 0u; slice < SLICES; slice++) {
        let phi = (f32(slice) + noise.x) * PI / f32(SLICES);
        let along = vec3(cos(phi), sin(phi), 0.0);
        let across = along - dot(along, viewer) * viewer;
        let axis = normalize(cross(across, viewer));
        let projected = normal - axis * dot(normal, axis);
        let weight = length(projected);
        let cos_n = clamp(dot(projected, viewer) / max(weight, 1e-6), 0.0, 1.0);
        let n = select(-1.0, 1.0, dot(across, projected) >= 0.0) * acos(cos_n);
        let lowest = vec2(cos(n + 0.5 * PI), cos(n - 0.5 * PI));
        var highest = lowest;
        for (var step = 0u; step < STEPS; step++) {
            // Denser near the point, and never the point itself.
            let share = (f32(step) + noise.y) / f32(STEPS);
            let offset = along.xy * vec2(1.0, -1.0) * (2.0 + share * share * radius_px);
            highest.x = max(highest.x, horizon(center, viewer, pixel, offset, radius, lowest.x));
            highest.y = max(highest.y, horizon(center, viewer, pixel, -offset, radius, lowest.y));
        }
        let sin_n = sin(n);
        let right = acos(clamp(highest.x, -1.0, 1.0));
        let left = -acos(clamp(highest.y, -1.0, 1.0));
        visible += weight * (arc(left, n, cos_n, sin_n) + arc(right, n, cos_n, sin_n));
    }
    return vec4(clamp(visible / f32(SLICES), 0.0, 1.0));
}

// How much a neighbour at half the size counts at a point of this distance ahead.
fn affinity(half_pixel: vec2<i32>, distance: f32, tolerance: f32) -> f32 {
    let depth = depth_at(2 * half_pixel);
    if depth <= 0.0 {
        return 0.0;
    }
    return max(0.0, 1.0 - abs(ahead(depth) - distance) / tolerance);
}

// Distances that differ by less than this are one surface: a share of the radius.
fn same_surface(distance: f32) -> f32 {
    return 0.35 * RADIUS * 2.0 * globals.unproject.y * select(distance, 1.0, globals.back.w > 0.0);
}

// The mean of a tile of four by four around each point, along the surface.
@fragment
fn fragment_smooth(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let half_pixel = vec2<i32>(at.xy);
    let depth = depth_at(2 * half_pixel);
    if depth <= 0.0 {
        return vec4(1.0);
    }
    let distance = ahead(depth);
    let tolerance = same_surface(distance);
    let size = vec2<i32>(textureDimensions(visibilities));
    var sum = 0.0;
    var total = 0.0;
    for (var y = -2; y <= 2; y++) {
        for (var x = -2; x <= 2; x++) {
            let near = clamp(half_pixel + vec2(x, y), vec2(0), size - 1);
            // Five wide with half weights at the ends: each angle of the tile counts once.
            let ends = select(1.0, 0.5, abs(x) == 2) * select(1.0, 0.5, abs(y) == 2);
            let weight = ends * affinity(near, distance, tolerance);
            sum += weight * textureLoad(visibilities, near, 0).r;
            total += weight;
        }
    }
    return vec4(select(1.0, sum / total, total > 0.0));
}

// Blended onto the image as a factor: the mean over the samples of a pixel of what is visible from each.
@fragment
fn fragment_apply(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
    let pixel = vec2<i32>(at.xy);
    let size = vec2<i32>(textureDimensions(visibilities));
    // The four neighbours at half the size, whose points are the upper left pixels of theirs.
    let base = pixel >> vec2(1u);
    let between = vec2<f32>(pixel - 2 * base) * 0.5;
    var near: array<vec2<i32>, 4>;
    var values: array<f32, 4>;
    for (var k = 0; k < 4; k++) {
        near[k] = min(base + vec2(k & 1, k >> 1u), size - 1);
        values[k] = textureLoad(visibilities, near[k], 0).r;
    }
    var factor = 0.0;
    for (var sample = 0; sample < 4; sample++) {
        let depth = textureLoad(depths, pixel, sample);
        var visible = 1.0;
        if depth > 0.0 && !(is_cut && textureLoad(colors, pixel, sample).a == 0.0) {
            let distance = ahead(depth);
            let tolerance = same_surface(distance);
            var sum = 0.0;
            var total = 0.0;
            for (var k = 0; k < 4; k++) {
                let share = select(1.0 - between, between, vec2((k & 1) == 1, k >= 2));
                let weight = (share.x * share.y + 1e-3) * (affinity(near[k], distance, tolerance) + 1e-4);
                sum += weight * values[k];
                total += weight;
            }
            visible = pow(sum / total, CONTRAST);
        }
        factor += 0.25 * mix(1.0, visible, globals.occlusion_strength);
    }
    // A factor on linear light is about its root on what is encoded.
    return vec4(vec3(select(factor, pow(factor, 1.0 / 2.2), encode_srgb)), 1.0);
}
