use super::vertex::{bend, to_middle};
use super::walk::MAX_RANKED;
use super::*;
use crate::mesh::Replica;
use crate::op::range_coder::uniform;
use crate::testing::{OperationRng, base_meshes};

/// The mesh of a replica with vertices and faces numbered and turned at random, and a second component beside it.
fn random_patch(seed: u64) -> Patch {
    let mut rng = OperationRng::new(seed);
    let meshes = base_meshes();
    let mut whole = Patch::default();
    for _ in 0..1 + rng.below(2) {
        let mut replica = Replica::new(&meshes[rng.below(6) as usize].1).unwrap();
        for _ in 0..rng.below(120) {
            rng.random_split(&mut replica);
        }
        let slots: Vec<u32> = replica.vertices().iter().collect();
        let offset = whole.positions.len() as u32;
        whole.positions.extend(slots.iter().map(|&s| replica.positions()[s as usize]));
        whole.colors.extend(slots.iter().map(|&s| replica.colors()[s as usize]));
        let number = |slot: u32| offset + slots.binary_search(&slot).unwrap() as u32;
        whole.faces.extend(replica.corners().filter(|&c| c != [0; 3]).map(|c| c.map(number)));
    }
    let mut order: Vec<u32> = (0..whole.positions.len() as u32).collect();
    let mut shuffled = Patch::default();
    for i in (1..order.len()).rev() {
        order.swap(i, rng.below(i as u32 + 1) as usize);
    }
    let mut numbers = vec![0; order.len()];
    for (number, &v) in (0..).zip(&order) {
        numbers[v as usize] = number;
        shuffled.positions.push(whole.positions[v as usize]);
        shuffled.colors.push(whole.colors[v as usize]);
    }
    for mut face in whole.faces {
        face.rotate_left(rng.below(3) as usize);
        shuffled.faces.push(face.map(|v| numbers[v as usize]));
    }
    shuffled
}

/// Patches in canonical order with one fan per vertex, small and larger, closed and open, with handles.
fn canonical_patches() -> Vec<Patch> {
    let small = base_meshes().into_iter().map(|(_, patch)| patch);
    let patches = small.chain((0..300).map(random_patch));
    let canonical: Vec<Patch> = patches.filter_map(|p| canonical_order(&p).map(|order| order.apply(&p))).collect();
    assert!(canonical.len() > 100 && canonical.iter().any(|p| p.faces.len() > 150));
    canonical
}

/// A flat grid of `side` x `side` squares.
fn flat_grid(side: u32) -> Patch {
    let row = side + 1;
    let positions: Vec<[i32; 3]> = (0..row * row).map(|i| [(i / row * 8) as i32, (i % row * 8) as i32, 5]).collect();
    let squares = (0..side * side).map(|i| i / side * row + i % side);
    Patch {
        colors: vec![[7; 3]; positions.len()],
        positions,
        faces: squares.flat_map(|a| [[a, a + row, a + row + 1], [a, a + row + 1, a + 1]]).collect(),
    }
}

#[test]
fn base_meshes_round_trip() {
    let tetrahedron = Patch {
        positions: vec![[0, 0, 0], [4095, 0, 7], [0, 4095, 9], [1, 2, 4095]],
        colors: vec![[0, 255, 3], [9, 9, 9], [255, 0, 0], [1, 2, 3]],
        faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    };
    let bytes = encode_base(&tetrahedron, 12, true);
    assert_eq!(decode_base(&bytes, 12, true), Ok(tetrahedron.clone()));
    assert_eq!(decode_base(&encode_base(&Patch::default(), 12, true), 12, true), Ok(Patch::default()));
    let mut longer = bytes.clone();
    longer.extend([1, 2, 3, 4, 5]);
    assert_eq!(decode_base(&longer, 12, true), Err(PatchDecodeError::Malformed));
}

#[test]
fn patches_in_any_order_round_trip() {
    let bow_tie =
        Patch { positions: vec![[1, 2, 3]; 5], colors: vec![[1, 2, 3]; 5], faces: vec![[0, 1, 2], [0, 3, 4]] };
    for patch in (0..200).map(random_patch).chain([bow_tie]) {
        assert_eq!(decode_base(&encode_base(&patch, 12, true), 12, true).as_ref(), Ok(&patch));
    }
}

#[test]
fn canonical_order_is_the_same_mesh_and_stays() {
    for seed in 0..200 {
        let patch = random_patch(seed);
        let Some(order) = canonical_order(&patch) else { continue };
        let canonical = order.apply(&patch);
        let again = canonical_order(&canonical).unwrap();
        assert!(again.vertices.iter().copied().eq(0..patch.positions.len() as u32), "seed {seed}");
        assert!(again.faces.iter().copied().eq((0..patch.faces.len() as u32).map(|f| (f, 0))), "seed {seed}");
        let mesh = |patch: &Patch| {
            let corner = |v: u32| (patch.positions[v as usize], patch.colors[v as usize]);
            let mut faces: Vec<_> = patch.faces.iter().map(|face| face.map(corner)).collect();
            for face in &mut faces {
                let first = (0..3).min_by_key(|&k| face[k]).unwrap();
                face.rotate_left(first);
            }
            faces.sort_unstable();
            faces
        };
        assert_eq!(mesh(&canonical), mesh(&patch), "seed {seed}");
    }
}

#[test]
fn only_canonical_patches_are_walked() {
    for patch in canonical_patches().into_iter().filter(|patch| !patch.faces.is_empty()) {
        let is_plain = |patch: &Patch| {
            let bytes = encode_base(patch, 12, true);
            assert_eq!(decode_base(&bytes, 12, true).as_ref(), Ok(patch));
            Decoder::new(&bytes).bit(&mut PatchModels::new(&TRAINED).is_plain, false)
        };
        assert!(!is_plain(&patch));
        let mut turned = patch.clone();
        turned.faces.last_mut().unwrap().rotate_left(1);
        assert!(turned.faces.len() == 1 || is_plain(&turned));
    }
    let grid = flat_grid(12);
    let canonical = canonical_order(&grid).unwrap().apply(&grid);
    let [plain, walked] = [&grid, &canonical].map(|patch| encode_base(patch, 12, true).len());
    assert!(3 * walked < plain, "{walked} against {plain} bytes");
}

/// A decoder of walks that searches lists: slow, and nothing else.
fn decode_dully(bytes: &[u8], lattice_bits: u8) -> Patch {
    struct Edge {
        from: u32,
        to: u32,
        opposite: u32,
    }
    let (mut coder, mut models) = (Decoder::new(bytes), PatchModels::new(&TRAINED));
    let coder = &mut coder;
    assert!(!coder.bit(&mut models.is_plain, false));
    let vertices = models.vertices.code(coder, 0) as usize;
    let faces = (2 * vertices as i32 - 4 + unzigzag(models.faces[0].code(coder, 0))) as usize;
    let is_closed = coder.bit(&mut models.is_closed, false);
    let mut out = Patch::default();
    // In the order in which they were added; the last one is the next gate.
    let mut border: Vec<Edge> = Vec::new();
    let mut boundary: Vec<u32> = Vec::new();
    'walk: while out.faces.len() < faces {
        let Some(&Edge { from: a, to: b, opposite }) = border.last() else {
            let first = out.positions.len();
            for k in 0..3 {
                let before = out.positions[first..].to_vec();
                out.positions.push(models.vertex.of_first_face(coder, lattice_bits, &before, [0; 3]).unwrap());
                let near = (k > 0).then(|| [out.colors[first], out.colors[first + k - 1]]);
                out.colors.push(models.vertex.color(coder, near, [0; 3]));
            }
            let v = first as u32;
            out.faces.push([v, v + 1, v + 2]);
            for k in 0..3 {
                border.push(Edge { from: v + k, to: v + (k + 1) % 3, opposite: v + (k + 2) % 3 });
            }
            continue;
        };
        let before = border.iter().filter(|edge| edge.to == a).map(|edge| edge.from).max();
        let after = border.iter().filter(|edge| edge.from == b).map(|edge| edge.to).max();
        let at = |v: u32| out.positions[v as usize];
        let left = bend(at(a), at(b), at(opposite), before.map(at));
        let right = bend(at(b), at(a), at(opposite), after.map(at));
        let next = out.positions.len() as u32;
        let fills = before.is_some() && before == after;
        let steps = &mut models.across.by_bend[left][right];
        let third = 'found: {
            if out.positions.len() < vertices && coder.bit(&mut steps.is_new, false) {
                break 'found next;
            }
            let is_before = if fills { &mut models.across.fills } else { &mut steps.is_before };
            if let Some(before) = before
                && coder.bit(is_before, false)
            {
                break 'found before;
            }
            if let Some(after) = after
                && !fills
                && coder.bit(&mut steps.is_after, false)
            {
                break 'found after;
            }
            let ends = usize::from(boundary.contains(&a)) + usize::from(boundary.contains(&b));
            if !is_closed && coder.bit(&mut models.across.is_boundary[ends], false) {
                border.pop();
                boundary.extend([a, b]);
                continue 'walk;
            }
            if border.len() > MAX_RANKED {
                break 'found uniform(coder, 0, next);
            }
            let mut rank = models.across.rank.code(coder, 0);
            let mut far = (0..next).filter(|&v| ![Some(a), Some(b), before, after].contains(&Some(v)));
            let mut nearest: Vec<u32> = far.by_ref().filter(|&v| border.iter().any(|edge| edge.from == v)).collect();
            loop {
                let nearest_of =
                    |list: &[u32]| *list.iter().min_by_key(|&&v| (to_middle(at(a), at(b), at(v)), v)).unwrap();
                let v = nearest_of(&nearest);
                if rank == 0 {
                    break v;
                }
                rank -= 1;
                nearest.retain(|&w| w != v);
            }
        };
        if third == next {
            let corners = [at(a), at(b), at(opposite)];
            out.positions.push(models.vertex.across(coder, lattice_bits, corners, [0; 3]).unwrap());
            let near = [out.colors[a as usize], out.colors[b as usize]];
            out.colors.push(models.vertex.color(coder, Some(near), [0; 3]));
        }
        out.faces.push([b, a, third]);
        border.pop();
        for (from, to, opposite) in [(a, third, b), (third, b, a)] {
            match border.iter().position(|edge| (edge.from, edge.to) == (to, from)) {
                Some(place) => drop(border.remove(place)),
                None => border.push(Edge { from, to, opposite }),
            }
        }
    }
    out
}

#[test]
fn a_dull_decoder_gets_the_same() {
    let larger = flat_grid(30);
    let larger = canonical_order(&larger).unwrap().apply(&larger);
    for patch in canonical_patches().into_iter().chain([larger]) {
        if !patch.faces.is_empty() {
            assert_eq!(decode_dully(&encode_base(&patch, 12, true), 12), patch);
        }
    }
}

#[test]
fn patches_share_contexts() {
    let patches = canonical_patches();
    let mut coder = Encoder::new();
    let mut models = PatchModels::new(&TRAINED);
    for patch in &patches {
        assert_eq!(models.code(&mut coder, 12, true, patch, |_, _, _| true).as_ref(), Ok(patch));
    }
    let bytes = coder.finish();
    let (mut coder, mut decoding) = (Decoder::new(&bytes), PatchModels::new(&TRAINED));
    for patch in &patches {
        let decoded = decoding.code(&mut coder, 12, true, &Patch::default(), |_, v, f| fits(bytes.len(), v, f));
        assert_eq!(decoded.as_ref(), Ok(patch));
    }
    assert!(models == decoding && !coder.is_overrun() && !coder.has_trailing());
}

#[test]
fn whatever_is_encoded_fits_its_bytes() {
    for side in [1, 20, 60, 300] {
        let grid = flat_grid(side);
        let canonical = canonical_order(&grid).unwrap().apply(&grid);
        for patch in [grid, canonical] {
            let bytes = encode_base(&patch, 12, true);
            assert_eq!(decode_base(&bytes, 12, true).as_ref(), Ok(&patch), "{side}: {} bytes", bytes.len());
        }
    }
    // More than a few bytes can mean.
    let mut coder = Encoder::new();
    let mut models = PatchModels::new(&TRAINED);
    coder.bit(&mut models.is_plain, false);
    models.vertices.code(&mut coder, 100_000);
    models.faces[0].code(&mut coder, 0);
    let refused = decode_base(&coder.finish(), 12, true);
    assert!(
        matches!(refused, Err(PatchDecodeError::TooLarge { vertices: 100_000, faces: 199_996, .. })),
        "{refused:?}"
    );
}

#[test]
fn any_bytes_are_safe() {
    let mut rng = fastrand::Rng::with_seed(11);
    for _ in 0..20_000 {
        let bytes: Vec<u8> = (0..rng.usize(0..60)).map(|_| rng.u8(..)).collect();
        let _ = decode_base(&bytes, 14, rng.bool());
    }
    let coded: Vec<Vec<u8>> = canonical_patches().iter().map(|patch| encode_base(patch, 12, true)).collect();
    let mut decoded = 0;
    for _ in 0..50_000 {
        let mut bytes = coded[rng.usize(0..coded.len())].clone();
        for _ in 0..1 + rng.usize(0..3) {
            let at = rng.usize(0..bytes.len());
            bytes[at] ^= 1 << rng.u8(0..8);
        }
        decoded += usize::from(decode_base(&bytes, 12, true).is_ok());
    }
    assert!(decoded > 0);
}
