// Where each vertex is shown and how each corner is lit: on its way from where it started, or in its place. The dull twin is `shown` in morph.rs.

@group(1) @binding(0) var<storage, read> targets: array<Vertex>;
// Five floats per slot, as GpuMorph: start, beginning in seconds, inverse duration (0 in its place).
@group(1) @binding(1) var<storage, read> states: array<f32>;
@group(1) @binding(2) var<storage, read_write> shown: array<Vertex>;

@compute @workgroup_size(64)
fn show(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let slot = id.y * groups.x * 64u + id.x;
    if slot >= globals.slot_end {
        return;
    }
    var vertex = targets[slot];
    let rate = states[5u * slot + 4u];
    let t = max((globals.morph_now_s - states[5u * slot + 3u]) * rate, 0.0);
    if rate > 0.0 && t < 1.0 {
        let start = vec3(states[5u * slot], states[5u * slot + 1u], states[5u * slot + 2u]);
        vertex.position = mix(start, vertex.position, t * t * (3.0 - 2.0 * t));
    }
    shown[slot] = vertex;
}

// Normals follow those of the mesh as it is: a share of the rest of the way with each image, so that they arrive when the
// vertices do. Corners outlive the ops around them (a split gives some of the corners of its vertex to the new one), so
// shading goes on where it was, although both vertices have other faces around them than the one had.

@group(1) @binding(0) var<storage, read> corner_normals: array<u32>;
@group(1) @binding(1) var<storage, read_write> shown_normals: array<u32>;

@compute @workgroup_size(64)
fn follow(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let corner = id.y * groups.x * 64u + id.x;
    if corner >= 6u * globals.slot_end {
        return;
    }
    let goal = corner_normals[corner];
    let before = shown_normals[corner];
    if goal == 0u || before == 0u {
        // No face or none before, or one whose normal is that of its plane.
        shown_normals[corner] = goal;
    } else if goal != before {
        shown_normals[corner] = packed_normal(mix(unpacked_normal(before), unpacked_normal(goal), globals.morph_share));
    }
}
