//! Which point of a mesh a ray meets.

use glam::DVec3;
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;

use crate::camera::ray::Ray;

/// Where a ray first meets a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// In model units.
    pub point: DVec3,
    /// From the ray's origin, in model units.
    pub distance: f64,
}

/// The first triangle along `ray` that is farther than `near` and whose point there is on the inner side of all `planes`
/// `(a, b, c, d)`. Both sides of a triangle count. Looks at every face: some 10 ns each.
pub fn first_hit(replica: &Replica, lattice: &Lattice, ray: &Ray, near: f64, planes: &[[f64; 4]]) -> Option<Hit> {
    // In lattice steps from the ray's origin, where positions are exact.
    let origin = DVec3::from_array(lattice.to_lattice(ray.origin.to_array()));
    let position = |slot: u32| glam::IVec3::from_array(replica.positions()[slot as usize]).as_dvec3() - origin;
    let mut first: Option<Hit> = None;
    for corners in replica.corners().filter(|corners| corners[0] != corners[1]) {
        let Some(steps) = crossing(ray.direction, corners.map(position)) else { continue };
        let distance = steps * lattice.step;
        if distance <= near || first.is_some_and(|first| first.distance <= distance) {
            continue;
        }
        let point = ray.at(distance);
        if planes.iter().all(|&[a, b, c, d]| DVec3::new(a, b, c).dot(point) + d >= 0.0) {
            first = Some(Hit { point, distance });
        }
    }
    first
}

/// Distance along a unit direction from the origin to the triangle's plane, if the ray meets the triangle (Möller and
/// Trumbore 1997). Edges count, so a ray cannot slip between two faces.
fn crossing(direction: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let (ab, ac) = (b - a, c - a);
    let p = direction.cross(ac);
    let determinant = ab.dot(p);
    if determinant == 0.0 {
        return None;
    }
    let u = -a.dot(p) / determinant;
    let q = (-a).cross(ab);
    let v = direction.dot(q) / determinant;
    const EDGE: f64 = 1e-9;
    let is_inside = u >= -EDGE && v >= -EDGE && u + v <= 1.0 + EDGE;
    is_inside.then(|| ac.dot(q) / determinant)
}

#[cfg(test)]
mod tests {
    use lodestream_protocol::ids::ViewSeq;

    use super::*;
    use crate::fake_server::FakeServer;

    /// All crossings by planes and half-planes, as one would do by hand.
    fn by_hand(replica: &Replica, lattice: &Lattice, ray: &Ray) -> Option<f64> {
        let point = |slot: u32| DVec3::from_array(lattice.position(replica.positions()[slot as usize]));
        let faces = replica.corners().filter(|corners| corners[0] != corners[1]);
        faces
            .filter_map(|corners| {
                let [a, b, c] = corners.map(point);
                let normal = (b - a).cross(c - a);
                let distance = (a - ray.origin).dot(normal) / ray.direction.dot(normal);
                let p = ray.at(distance);
                let inside = [(a, b), (b, c), (c, a)].iter().all(|&(s, e)| (e - s).cross(p - s).dot(normal) >= 0.0);
                (inside && distance > 0.0).then_some(distance)
            })
            .min_by(f64::total_cmp)
    }

    #[test]
    fn rays_meet_what_they_meet_by_hand() {
        let mut server = FakeServer::new();
        (0..4).for_each(|_| drop(server.batch(ViewSeq(1), 200)));
        let (replica, lattice) = (server.replica(), server.model().lattice);
        let mut rng = fastrand::Rng::with_seed(11);
        let center = DVec3::from_array(lattice.position([400, 400, 400]));
        let mut random = || DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5);
        let mut hits = 0;
        for _ in 0..300 {
            let origin = center + random() * 3000.0;
            let ray = Ray { origin, direction: (center + random() * 400.0 - origin).normalize() };
            let (hit, expected) = (first_hit(replica, &lattice, &ray, 0.0, &[]), by_hand(replica, &lattice, &ray));
            match (hit, expected) {
                (Some(hit), Some(expected)) => {
                    assert!((hit.distance - expected).abs() < 1e-6 * expected, "{hit:?} {expected}");
                    hits += 1;
                    // Cut away what was met: the next one is behind it.
                    let n = ray.direction;
                    let plane = [n.x, n.y, n.z, -n.dot(hit.point) - 1e-6];
                    let behind = first_hit(replica, &lattice, &ray, 0.0, &[plane]);
                    assert!(behind.is_none_or(|behind| behind.distance > hit.distance));
                    assert_eq!(
                        behind.is_some(),
                        first_hit(replica, &lattice, &ray, hit.distance + 1e-6, &[]).is_some()
                    );
                }
                (None, None) => {}
                other => panic!("{other:?}"),
            }
        }
        assert!(hits > 50, "{hits}");
    }
}
