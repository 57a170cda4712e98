use super::*;
use crate::testing::{OperationRng, base_meshes, check_replica};

#[test]
fn random_splits_undone_in_any_legal_order_restore_the_base() {
    for (name, base) in base_meshes() {
        for seed in 0..8 {
            let mut rng = OperationRng::new(seed);
            let mut replica = Replica::new(&base).unwrap();
            let before = replica.digest();
            for _ in 0..60 {
                rng.random_split(&mut replica);
            }
            check_replica(&replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            for _ in 0..600 {
                if rng.random_collapse(&mut replica).is_none() {
                    break;
                }
                if rng.one_in(4) {
                    rng.random_split(&mut replica);
                }
            }
            check_replica(&replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            while rng.random_collapse(&mut replica).is_some() {}
            check_replica(&replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            assert_eq!(replica.digest(), before, "{name} {seed}");
            assert_eq!(replica.triangle_count() as usize, base.faces.len(), "{name} {seed}");
        }
    }
}

#[test]
fn spawns_take_the_smallest_free_slots_and_give_them_back() {
    let (_, base) = base_meshes().swap_remove(0);
    let mut replica = Replica::new(&base).unwrap();
    let before = replica.digest();
    let patches: Vec<_> = base_meshes().into_iter().map(|(_, patch)| patch).filter(|p| !p.faces.is_empty()).collect();
    let mut addresses = Vec::new();
    for (id, patch) in patches.iter().enumerate() {
        let address = replica.spawn(id as u32, patch).unwrap();
        assert_eq!(replica.spawn(id as u32, patch), Err(ApplyError::SpawnedTwice(id as u32)));
        addresses.push(address);
        check_replica(&replica).unwrap();
    }
    let removed = addresses.remove(1);
    replica.despawn(removed).unwrap();
    assert_eq!(replica.spawn(1, &patches[1]).unwrap(), removed, "the freed slots are the smallest");
    replica.despawn(removed).unwrap();
    for address in addresses {
        replica.despawn(address).unwrap();
    }
    check_replica(&replica).unwrap();
    assert_eq!(replica.digest(), before);
}

#[test]
fn a_spawn_with_splits_may_not_vanish() {
    let base = Patch::default();
    let (_, patch) = base_meshes().into_iter().find(|(name, _)| *name == "tetrahedron").unwrap();
    let mut replica = Replica::new(&base).unwrap();
    let address = replica.spawn(9, &patch).unwrap();
    let mut rng = OperationRng::new(1);
    let t = rng.random_split(&mut replica).unwrap();
    assert_eq!(replica.despawn(address), Err(ApplyError::NotCollapsible(address.0)));
    replica.collapse(t, &mut Vec::new()).unwrap();
    assert_eq!(replica.despawn(address).unwrap().0, 9);
    assert_eq!((replica.triangle_count(), replica.vertex_count(), replica.digest()), (0, 0, 0));
}

/// ```text
///        l                 l
///      / | \             / | \
///     a  s  b    =>     a--s-t--b   (the faces right of the cut move to t)
///      \ | /             \ | /
///        r                 r
/// ```
#[test]
fn a_split_moves_the_arc_from_right_to_left() {
    let base = Patch {
        positions: vec![[5, 5, 0], [5, 9, 0], [1, 5, 0], [5, 1, 0], [9, 5, 0]],
        colors: vec![[0; 3]; 5],
        // s = 0; counter-clockwise: l = 1, a = 2, r = 3, b = 4.
        faces: vec![[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]],
    };
    let mut replica = Replica::new(&base).unwrap();
    let mut fan = Fan::default();
    replica.fan(VertexSlot(0), &mut fan).unwrap();
    assert_eq!((fan.ring(), fan.is_closed()), (&[1, 2, 3, 4][..], true));
    let vertex = NewVertex { position: [7, 5, 0], ..Default::default() };
    let t = replica.split(VertexSlot(0), &fan, Cut::Both { right: 2, left: 0 }, &vertex).unwrap();
    assert_eq!(t, VertexSlot(5));
    assert_eq!(
        replica.corners().collect::<Vec<_>>(),
        [
            [0, 1, 2],
            [0, 2, 3],
            [5, 3, 4],
            [5, 4, 1],
            [0; 3],
            [0; 3],
            [0; 3],
            [0; 3],
            [0; 3],
            [0; 3],
            [0, 5, 1],
            [5, 0, 3]
        ]
    );
    check_replica(&replica).unwrap();
    let undo = replica.collapse(t, &mut Vec::new()).unwrap();
    assert_eq!(undo, SplitUndo { s: VertexSlot(0), vertex, left: VertexSlot(1), right: VertexSlot(3) });
    assert_eq!(replica.corners().take(4).collect::<Vec<_>>(), base.faces);
}

#[test]
fn refused_ops_change_nothing() {
    let (_, base) = base_meshes().swap_remove(0);
    let mut replica = Replica::new(&base).unwrap();
    let before = replica.digest();
    let mut fan = Fan::default();
    assert_eq!(replica.fan(VertexSlot(1000), &mut fan), Err(ApplyError::NoVertex(1000)));
    replica.fan(VertexSlot(0), &mut fan).unwrap();
    let cut = Cut::Both { right: 1, left: 1 };
    assert!(matches!(replica.split(VertexSlot(0), &fan, cut, &NewVertex::default()), Err(ApplyError::BadCut { .. })));
    assert_eq!(replica.collapse(VertexSlot(0), &mut Vec::new()), Err(ApplyError::NotCollapsible(0)));
    assert_eq!(replica.despawn(VertexSlot(7)), Err(ApplyError::NotCollapsible(7)));
    assert_eq!(replica.digest(), before);
    check_replica(&replica).unwrap();
}
