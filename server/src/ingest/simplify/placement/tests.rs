use fastrand::Rng;

use super::*;

const MAX: i32 = 4095;

fn point(position: [i32; 3], color: [u8; 3]) -> Point {
    Point { position, color, is_boundary: false }
}

fn random_vector(rng: &mut Rng, size: f64) -> DVec3 {
    DVec3::from_array([0; 3].map(|_: i32| (rng.f64() - 0.5) * 2.0 * size))
}

/// Planes that are nearly parallel, meet in a ridge, or lie anyhow.
fn random_planes(rng: &mut Rng) -> Planes {
    let mut planes = Planes::default();
    let (first, second) = (random_vector(rng, 200.0), random_vector(rng, 200.0));
    let spread = [0.0, 5.0, 100.0][rng.usize(0..3)];
    for i in 0..6 {
        planes.add(&Planes::of_face(if i % 2 == 0 { first } else { second } + random_vector(rng, spread)));
    }
    planes
}

fn random_edge(rng: &mut Rng) -> [Point; 2] {
    let first = [0; 3].map(|_: i32| rng.i32(100..MAX - 100));
    let second = first.map(|c| c + rng.i32(-12..=12));
    [first, second].map(|position| point(position, [0; 3].map(|_: u8| rng.u8(..))))
}

/// No lattice point within reach is cheaper than the optimal place by more than rounding and the pull account for.
#[test]
fn optimal_is_what_a_search_of_the_lattice_finds() {
    let mut rng = Rng::with_seed(5);
    let mut moved = 0;
    for _ in 0..300 {
        let ends = random_edge(&mut rng).map(|end| point(end.position, [9; 3]));
        let planes = [random_planes(&mut rng), random_planes(&mut rng)];
        let edge = Edge { ends: [&ends[0], &ends[1]], planes: [&planes[0], &planes[1]], max: MAX };
        let place = optimal::Optimal.place(&edge);
        let cost = |at: [i32; 3]| edge.cost(at, share(edge.ends, at));
        assert_eq!(place.cost, cost(place.at));
        for other in [subset::Subset.place(&edge), midpoint::Midpoint.place(&edge), endpoint::Endpoint.place(&edge)] {
            assert!(place.cost <= other.cost);
        }
        let [a, b] = ends.map(|end| end.at());
        let middle = (a + b) * 0.5;
        let weight = planes[0].weight + planes[1].weight;
        let rounding = 0.75 * weight * (1.0 + optimal::PULL);
        let reach = optimal::MAX_REACH * a.distance(b);
        let within = |offset: DVec3| offset.length() <= reach;
        // Where the least is out of reach, the rule says nothing but the above.
        let least = super::quadric::Minimum::new(edge.planes, [a, b], middle, optimal::PULL).map(|m| m.offset());
        if !least.is_some_and(within) {
            continue;
        }
        moved += usize::from(ends.iter().all(|end| end.position != place.at));
        for i in 0..25 * 25 * 25 {
            let at = [i % 25, i / 25 % 25, i / 625].map(|d| d - 12);
            let at: [i32; 3] = std::array::from_fn(|k| middle[k] as i32 + at[k]);
            let pull = optimal::PULL * weight * vector(at).distance_squared(middle);
            assert!(place.cost <= cost(at) + pull + rounding, "{place:?} against {at:?}");
        }
    }
    assert!(moved > 50, "{moved}");
}

#[test]
fn settling_keeps_the_volume_up_to_rounding() {
    let mut rng = Rng::with_seed(6);
    let mut settled = 0;
    for _ in 0..500 {
        let ends = random_edge(&mut rng);
        let planes = [random_planes(&mut rng), random_planes(&mut rng)];
        let edge = Edge { ends: [&ends[0], &ends[1]], planes: [&planes[0], &planes[1]], max: MAX };
        let place = optimal::Optimal.place(&edge);
        let normal = random_vector(&mut rng, 100.0);
        let height = normal.dot(vector(place.at)) + rng.f64() * 500.0;
        let after = optimal::Optimal.settle(&edge, place, &|| Volume { normal, height });
        if after.at != place.at {
            settled += 1;
            let left = (normal.dot(vector(after.at)) - height).abs();
            assert!(left <= 0.5 * (normal.x.abs() + normal.y.abs() + normal.z.abs()) + 1e-6, "{left}");
        }
    }
    assert!(settled > 100, "{settled}");
}

#[test]
fn midpoints_are_known_from_one_end_and_a_bit_per_axis() {
    let mut rng = Rng::with_seed(7);
    let mut bias = 0;
    for _ in 0..2000 {
        let ends = random_edge(&mut rng);
        let planes = [random_planes(&mut rng), random_planes(&mut rng)];
        let place =
            midpoint::Midpoint.place(&Edge { ends: [&ends[0], &ends[1]], planes: [&planes[0], &planes[1]], max: MAX });
        let (s, t) = if place.keeps_first { (&ends[0], &ends[1]) } else { (&ends[1], &ends[0]) };
        for k in 0..3 {
            let rounded = s.position[k] + t.position[k] - 2 * place.at[k];
            assert!(rounded == 0 || rounded == if t.position[k] % 2 == 1 { -1 } else { 1 });
            bias += rounded;
        }
    }
    assert!(bias.abs() < 200, "{bias}");
}

#[test]
fn colours_are_those_of_the_place_along_the_edge() {
    let ends = [point([10, 10, 10], [0, 100, 255]), point([40, 10, 10], [30, 100, 0])];
    let color_at = |at| color(ends[0].color, ends[1].color, share([&ends[0], &ends[1]], at));
    assert_eq!(color_at([10, 10, 10]), [0, 100, 255]);
    assert_eq!(color_at([40, 10, 10]), [30, 100, 0]);
    assert_eq!(color_at([20, 90, 0]), [10, 100, 170]);
    assert_eq!(color_at([99, 10, 10]), [30, 100, 0]);
    assert_eq!(share([&ends[0], &ends[0]], [5; 3]), 0.0);
}
