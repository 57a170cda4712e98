// Normals per corner from the faces alone, in two passes.
//
// `link` computes face normals and strings the corners of each vertex into a list. `smooth_corners` orders each vertex's
// faces around it, cuts the fan where faces meet at more than the crease angle and gives all corners between two cuts the
// area-weighted mean of their faces. Costs O(faces) and touches a face about four times.

@group(1) @binding(0) var<storage, read> vertices: array<Vertex>;
@group(1) @binding(1) var<storage, read> indices: array<u32>;
// Per vertex slot the first corner of its list plus 1, then from `capacity_slots` on per corner the next one; 0 ends.
@group(1) @binding(2) var<storage, read_write> links: array<atomic<u32>>;
// xyz: unit normal; w: twice the area, negative if the normal cannot be relied on, 0 without area.
@group(1) @binding(3) var<storage, read_write> face_normals: array<vec4<f32>>;
@group(1) @binding(4) var<storage, read_write> corner_normals: array<u32>;

// A face lower than this many lattice steps has a normal that is mostly rounding (each corner is off by half a step).
// It never makes a crease and hardly weighs.
const RELIABLE_HEIGHT: f32 = 2.0;
const UNRELIABLE_WEIGHT: f32 = 1e-3;
const MOST_ORDERED: u32 = 32u;
const MOST_LISTED: u32 = 2048u;
const MOST_GROUPS: u32 = 6u;

fn element(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.y * groups.x * 64u + id.x;
}

@compute @workgroup_size(64)
fn link(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let face = element(id, groups);
    if face >= 2u * globals.slot_end {
        return;
    }
    let first = 3u * face;
    let slots = vec3(indices[first], indices[first + 1u], indices[first + 2u]);
    if slots.x == slots.y {
        return; // No face in this slot.
    }
    let a = vertices[slots.x].position;
    let ab = vertices[slots.y].position - a;
    let ac = vertices[slots.z].position - a;
    let bc = ac - ab;
    let area_vector = cross(ab, ac);
    let area = length(area_vector);
    let longest = sqrt(max(dot(ab, ab), max(dot(ac, ac), dot(bc, bc))));
    let is_reliable = area >= RELIABLE_HEIGHT * longest;
    face_normals[face] = vec4(direction(area_vector), select(-area, area, is_reliable));
    let next = globals.capacity_slots + first;
    atomicStore(&links[next], atomicExchange(&links[slots.x], first + 1u));
    atomicStore(&links[next + 1u], atomicExchange(&links[slots.y], first + 2u));
    atomicStore(&links[next + 2u], atomicExchange(&links[slots.z], first + 3u));
}

fn weighted(normal: vec4<f32>) -> vec3<f32> {
    return normal.xyz * select(-normal.w * UNRELIABLE_WEIGHT, normal.w, normal.w > 0.0);
}

// One spoke of a vertex: a corner with the vertices after and before it in its face.
struct Spoke {
    normal: vec4<f32>,
    corner: u32,
    next: u32,
    previous: u32,
}

var<private> fan: array<Spoke, 32>;

fn swap_spokes(i: u32, j: u32) {
    if i != j {
        let spoke = fan[i];
        fan[i] = fan[j];
        fan[j] = spoke;
    }
}

// Counter-clockwise from the boundary start of an open fan, from anywhere in a closed one.
fn order_fan(count: u32) {
    for (var i = 0u; i < count; i++) {
        var is_start = true;
        for (var j = 0u; j < count; j++) {
            is_start = is_start && fan[j].previous != fan[i].next;
        }
        if is_start {
            swap_spokes(0u, i);
            break;
        }
    }
    for (var i = 1u; i < count; i++) {
        for (var j = i; j < count; j++) {
            if fan[j].next == fan[i - 1u].previous {
                swap_spokes(i, j);
                break;
            }
        }
    }
}

// A crease between the last reliable face, of normal `before`, and spoke `i`: where among the unreliable ones in between.
// They lie on either side of the edge, and what their normals say is enough to tell which.
fn cut_before(i: u32, count: u32, before: vec3<f32>) -> u32 {
    var at = i;
    for (var n = 1u; n < count; n++) {
        let previous = (at + count - 1u) % count;
        let normal = fan[previous].normal;
        if normal.w > 0.0 || dot(normal.xyz, fan[i].normal.xyz) <= dot(normal.xyz, before) {
            break;
        }
        at = previous;
    }
    return at;
}

@compute @workgroup_size(64)
fn smooth_corners(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let vertex = element(id, groups);
    if vertex >= globals.slot_end {
        return;
    }
    let head = atomicLoad(&links[vertex]);
    var count = 0u;
    var at = head;
    while at != 0u && count < MOST_ORDERED {
        let corner = at - 1u;
        let k = corner % 3u;
        let first = corner - k;
        fan[count].normal = face_normals[corner / 3u];
        fan[count].corner = corner;
        fan[count].next = indices[first + (k + 1u) % 3u];
        fan[count].previous = indices[first + (k + 2u) % 3u];
        count++;
        at = atomicLoad(&links[globals.capacity_slots + corner]);
    }
    if count == 0u {
        return;
    }
    if at != 0u {
        smooth_large_fan(head);
        return;
    }
    order_fan(count);

    let is_closed = count > 1u && fan[count - 1u].previous == fan[0].next;
    // The last face before the first spoke whose normal says something.
    var before = vec3(0.0);
    if is_closed {
        for (var i = 0u; i < count; i++) {
            if fan[i].normal.w > 0.0 {
                before = fan[i].normal.xyz;
            }
        }
    }
    var cuts = 0u;
    for (var i = 0u; i < count; i++) {
        let normal = fan[i].normal;
        if normal.w > 0.0 {
            if dot(before, before) > 0.0 && dot(before, normal.xyz) < globals.crease_cosine {
                cuts |= 1u << cut_before(i, count, before);
            }
            before = normal.xyz;
        }
    }
    // Groups run from cut to cut, around the seam of a closed fan.
    var start = 0u;
    if is_closed && cuts != 0u {
        start = firstTrailingBit(cuts);
    }
    var begin = 0u;
    var sum = vec3(0.0);
    for (var i = 0u; i < count; i++) {
        let spoke = (start + i) % count;
        sum += weighted(fan[spoke].normal);
        let after = (start + i + 1u) % count;
        if i + 1u == count || (cuts & (1u << after)) != 0u {
            let code = packed_normal(sum);
            for (var j = begin; j <= i; j++) {
                corner_normals[fan[(start + j) % count].corner] = code;
            }
            begin = i + 1u;
            sum = vec3(0.0);
        }
    }
}

// Too many faces to order: the largest face gathers all that are within the crease angle of it, then the largest of the
// rest, and so on. One mean for all would let the wall tilt the floor where a rim vertex has a fan of many. What is left
// after a few rounds, and corners beyond MOST_LISTED, keep their face's normal, so that no vertex keeps the device busy.
fn smooth_large_fan(head: u32) {
    var first_code = 0u;
    for (var round = 0u; round < MOST_GROUPS; round++) {
        var largest = vec4(0.0);
        var at = head;
        for (var i = 0u; i < MOST_LISTED && at != 0u; i++) {
            let normal = face_normals[(at - 1u) / 3u];
            if corner_normals[at - 1u] == 0u && normal.w > largest.w {
                largest = normal;
            }
            at = atomicLoad(&links[globals.capacity_slots + at - 1u]);
        }
        if largest.w == 0.0 {
            break;
        }
        var sum = vec3(0.0);
        at = head;
        for (var i = 0u; i < MOST_LISTED && at != 0u; i++) {
            let normal = face_normals[(at - 1u) / 3u];
            if joins(at - 1u, normal, largest.xyz) {
                sum += weighted(normal);
            }
            at = atomicLoad(&links[globals.capacity_slots + at - 1u]);
        }
        let code = packed_normal(sum);
        first_code = select(first_code, code, round == 0u);
        at = head;
        for (var i = 0u; i < MOST_LISTED && at != 0u; i++) {
            if joins(at - 1u, face_normals[(at - 1u) / 3u], largest.xyz) {
                corner_normals[at - 1u] = code;
            }
            at = atomicLoad(&links[globals.capacity_slots + at - 1u]);
        }
    }
    var at = head;
    for (var i = 0u; i < MOST_LISTED && at != 0u; i++) {
        if corner_normals[at - 1u] == 0u && face_normals[(at - 1u) / 3u].w <= 0.0 {
            corner_normals[at - 1u] = first_code;
        }
        at = atomicLoad(&links[globals.capacity_slots + at - 1u]);
    }
}

// Whether the corner is still free and its face may be shaded with faces of this normal.
fn joins(corner: u32, normal: vec4<f32>, seed: vec3<f32>) -> bool {
    return corner_normals[corner] == 0u && dot(normal.xyz, seed) >= globals.crease_cosine;
}
