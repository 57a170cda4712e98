//! From a signed field to a clean closed quad mesh: dual marching cubes on a sparse lattice.
//!
//! Every loop that marching cubes would draw in a cell becomes one vertex and every lattice edge that crosses the
//! surface becomes one quad, which is the dual of a closed polygon mesh and so a manifold. Only one thing can spoil it:
//! two neighbouring cells whose single loops both touch their common, ambiguous face twice. There the face is resolved
//! the other way, as in Wenger, *Isosurfaces* (2013), section 5.6, which splits both loops.
//!
//! Cells are stored in bricks of 4 x 4 x 4, bricks in blocks of 8 x 8 x 8. Blocks far from the surface are skipped by a
//! Lipschitz test, so time and memory go with the surface and not with the volume. The test need not be right:
//! [`Contour::scan`] afterwards follows the surface into any brick that was skipped in error.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use glam::DVec3;

/// Cells along a brick.
const BRICK: usize = 4;
/// Cells along a block.
const BLOCK: usize = 32;
/// Bricks along a block.
const PER_BLOCK: usize = BLOCK / BRICK;
/// How fast the field may change per unit of length, for skipping empty space.
const LIPSCHITZ: f64 = 1.25;
/// The same for single bricks, where a miss costs little: it is found by following the surface.
const LIPSCHITZ_BRICK: f64 = 0.85;
/// Index of an absent brick in a block's table.
const ABSENT: u32 = u32::MAX;

/// A cubic lattice over a box: corner (i, j, k) lies at `origin + step * (i, j, k)`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lattice {
    origin: DVec3,
    step: f64,
    /// Blocks along each axis.
    blocks: [usize; 3],
}

impl Lattice {
    /// Covers the box from `lo` to `hi` with cells of edge `step`.
    pub(super) fn covering(lo: DVec3, hi: DVec3, step: f64) -> Self {
        let extent = (hi - lo) / (step * BLOCK as f64);
        Self { origin: lo, step, blocks: extent.to_array().map(|cells| cells as usize + 1) }
    }

    fn corner(&self, at: [usize; 3]) -> DVec3 {
        self.origin + DVec3::new(at[0] as f64, at[1] as f64, at[2] as f64) * self.step
    }

    fn bricks(&self) -> [usize; 3] {
        self.blocks.map(|n| n * PER_BLOCK)
    }

    fn block_count(&self) -> usize {
        self.blocks.iter().product()
    }

    fn block_at(&self, index: usize) -> [usize; 3] {
        let [nx, ny, _] = self.blocks;
        [index % nx, index / nx % ny, index / (nx * ny)]
    }

    /// Block that holds brick `at`, and the brick's place in the block's table.
    fn address(&self, at: [usize; 3]) -> (usize, usize) {
        let block = at.map(|a| a / PER_BLOCK);
        let local = at.map(|a| a % PER_BLOCK);
        let [nx, ny, _] = self.blocks;
        ((block[2] * ny + block[1]) * nx + block[0], (local[2] * PER_BLOCK + local[1]) * PER_BLOCK + local[0])
    }
}

/// A quad mesh; corners counter-clockwise seen from where the field is positive.
#[derive(Debug, Default)]
pub(super) struct QuadMesh {
    pub(super) positions: Vec<[f64; 3]>,
    pub(super) quads: Vec<[u32; 4]>,
}

/// The signs of a field on a lattice near its surface, enough to count and then to build the mesh.
pub(super) struct Contour {
    lattice: Lattice,
    /// Per block, place of each of its bricks in `bricks`, or no table where the block is empty.
    tables: Vec<Option<Box<[u32]>>>,
    bricks: Vec<Brick>,
    quads: usize,
}

struct Brick {
    /// In bricks from the origin.
    at: [usize; 3],
    /// Per cell, bit `c` is set where corner `c` is inside.
    cases: [u8; 64],
    /// Cells whose problem face is resolved the other way.
    flipped: u64,
    /// Vertices in earlier cells of this brick.
    before: [u16; 64],
    first_vertex: u32,
    /// Crossing averages in units of the step from the cell's corner, for the loops of the unflipped cells in order.
    offsets: Vec<[f32; 3]>,
}

impl Contour {
    /// Samples `field` (negative inside) around its surface. The result does not depend on `threads`.
    pub(super) fn scan<F: Fn(DVec3) -> f64 + Sync>(lattice: Lattice, field: &F, threads: usize) -> Self {
        let next = AtomicUsize::new(0);
        let worker = || {
            let mut found = Vec::new();
            let mut cache = vec![f32::NAN; (BLOCK + 1).pow(3)];
            loop {
                let block = next.fetch_add(1, Ordering::Relaxed);
                if block >= lattice.block_count() {
                    return found;
                }
                let bricks = scan_block(&lattice, lattice.block_at(block), field, &mut cache);
                if !bricks.is_empty() {
                    found.push((block, bricks));
                }
            }
        };
        let mut found: Vec<(usize, Vec<Brick>)> = thread::scope(|scope| {
            let workers: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(worker)).collect();
            workers.into_iter().flat_map(|w| w.join().expect("a field does not panic")).collect()
        });
        found.sort_unstable_by_key(|(block, _)| *block);

        let mut contour = Self { lattice, tables: vec![None; lattice.block_count()], bricks: Vec::new(), quads: 0 };
        for (_, bricks) in found {
            for brick in bricks {
                contour.insert(brick);
            }
        }
        contour.follow(field);
        contour.quads = contour.bricks.iter().map(|b| owned_edges(&b.cases)).sum();
        contour
    }

    /// Triangles that [`Contour::build`] will lead to: two for each quad.
    pub(super) fn triangle_count(&self) -> usize {
        2 * self.quads
    }

    /// Vertices and quads, in lattice order.
    pub(super) fn build<F: Fn(DVec3) -> f64>(mut self, field: &F) -> QuadMesh {
        let positions = self.place_vertices(field);
        let mut quads = Vec::with_capacity(self.quads);
        for brick in &self.bricks {
            self.append_quads(brick, &mut quads);
        }
        QuadMesh { positions, quads }
    }

    fn insert(&mut self, brick: Brick) {
        let (block, local) = self.lattice.address(brick.at);
        let table = self.tables[block].get_or_insert_with(|| vec![ABSENT; PER_BLOCK.pow(3)].into_boxed_slice());
        table[local] = u32::try_from(self.bricks.len()).expect("memory ends before 2^32 bricks");
        self.bricks.push(brick);
    }

    fn brick(&self, at: [usize; 3]) -> Option<&Brick> {
        let (block, local) = self.lattice.address(at);
        let index = self.tables.get(block)?.as_ref()?[local];
        self.bricks.get(index as usize)
    }

    /// Adds every brick that the surface reaches through a face of a known one.
    fn follow<F: Fn(DVec3) -> f64>(&mut self, field: &F) {
        let limits = self.lattice.bricks();
        let mut next = 0;
        while next < self.bricks.len() {
            for face in 0..6 {
                let at = self.bricks[next].at;
                let Some(neighbour) = step_through(at, face, limits) else { continue };
                if self.brick(neighbour).is_none() && surface_leaves(&self.bricks[next].cases, face) {
                    let lattice = self.lattice;
                    let base = neighbour.map(|a| a * BRICK);
                    let mut sample = |c: [usize; 3]| field(lattice.corner([0, 1, 2].map(|k| base[k] + c[k]))) as f32;
                    self.insert(read_brick(neighbour, &mut sample));
                }
            }
            next += 1;
        }
    }

    fn place_vertices<F: Fn(DVec3) -> f64>(&mut self, field: &F) -> Vec<[f64; 3]> {
        let tables = tables();
        let flips: Vec<u64> = self.bricks.iter().map(|brick| self.flips(brick)).collect();
        let mut positions = Vec::new();
        for (brick, flipped) in self.bricks.iter_mut().zip(flips) {
            brick.flipped = flipped;
            brick.first_vertex = u32::try_from(positions.len()).expect("vertices are indexed by u32");
            let mut offsets = std::mem::take(&mut brick.offsets).into_iter();
            let mut count = 0;
            for cell in 0..64 {
                brick.before[cell] = count;
                let case = brick.cases[cell];
                let lo = [0, 1, 2].map(|k| brick.at[k] * BRICK + cell_coordinates(cell)[k]);
                let plain = &tables.loops[usize::from(case)][0];
                let mut push = |offset: [f32; 3]| {
                    let corner = self.lattice.corner(lo);
                    positions.push((corner + DVec3::from_array(offset.map(f64::from)) * self.lattice.step).to_array());
                };
                if flipped >> cell & 1 == 0 {
                    offsets.by_ref().take(usize::from(plain.count)).for_each(&mut push);
                    count += u16::from(plain.count);
                    continue;
                }
                offsets.by_ref().take(usize::from(plain.count)).for_each(drop);
                let split = &tables.loops[usize::from(case)][1];
                let values: [f32; 8] =
                    std::array::from_fn(|c| field(self.lattice.corner([0, 1, 2].map(|k| lo[k] + (c >> k & 1)))) as f32);
                loop_centres(split, case, &values).for_each(&mut push);
                count += u16::from(split.count);
            }
        }
        positions
    }

    /// Cells of `brick` that share an ambiguous face with another problem cell.
    fn flips(&self, brick: &Brick) -> u64 {
        let tables = tables();
        let mut flips = 0;
        for cell in 0..64 {
            let Some(face) = tables.problem[usize::from(brick.cases[cell])] else { continue };
            let across = self.cell_across(brick, cell, face).map(|(b, c)| b.cases[c]);
            if across.is_some_and(|case| tables.problem[usize::from(case)] == Some(face ^ 1)) {
                flips |= 1 << cell;
            }
        }
        flips
    }

    fn cell_across<'a>(&'a self, brick: &'a Brick, cell: usize, face: usize) -> Option<(&'a Brick, usize)> {
        let local = cell_coordinates(cell);
        match step_through(local, face, [BRICK; 3]) {
            Some(inside) => Some((brick, cell_index(inside))),
            None => {
                let neighbour = self.brick(step_through(brick.at, face, self.lattice.bricks())?)?;
                let mut wrapped = local;
                wrapped[face / 2] = BRICK - 1 - local[face / 2];
                Some((neighbour, cell_index(wrapped)))
            }
        }
    }

    /// One quad for each crossing edge that starts at the lowest corner of a cell of `brick`.
    fn append_quads(&self, brick: &Brick, quads: &mut Vec<[u32; 4]>) {
        for cell in 0..64 {
            let case = brick.cases[cell];
            if case == 0 || case == 255 {
                continue;
            }
            for axis in 0..3 {
                let (inside, far) = (case & 1 != 0, case >> (1 << axis) & 1 != 0);
                if inside == far {
                    continue;
                }
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                // The four cells around the edge, counter-clockwise seen from the far end of the axis.
                let corner = |du: bool, dv: bool| {
                    let mut at = Some((brick, cell));
                    if du {
                        at = at.and_then(|(b, c)| self.cell_across(b, c, 2 * u));
                    }
                    if dv {
                        at = at.and_then(|(b, c)| self.cell_across(b, c, 2 * v));
                    }
                    let start = (usize::from(du) << u) | (usize::from(dv) << v);
                    at.map(|(b, c)| b.vertex(c, edge_index(start, axis)))
                };
                let ring = (corner(false, false), corner(true, false), corner(true, true), corner(false, true));
                // A surface that leaves the lattice ends there: the quad lacks cells and is left out.
                if let (Some(a), Some(b), Some(c), Some(d)) = ring {
                    quads.push(if inside { [a, b, c, d] } else { [d, c, b, a] });
                }
            }
        }
    }
}

impl Brick {
    /// Vertex of the loop that crosses `edge` of `cell`.
    fn vertex(&self, cell: usize, edge: usize) -> u32 {
        let flipped = (self.flipped >> cell & 1) as usize;
        let loops = &tables().loops[usize::from(self.cases[cell])][flipped];
        self.first_vertex + u32::from(self.before[cell]) + u32::from(loops.of_edge[edge])
    }
}

/// Bricks of one block that the surface may cross. `cache` has a place for each corner of the block.
fn scan_block<F: Fn(DVec3) -> f64>(lattice: &Lattice, block: [usize; 3], field: &F, cache: &mut [f32]) -> Vec<Brick> {
    let base = block.map(|b| b * BLOCK);
    // Is the surface within a cube of `cells` cells at `lo`, as far as its centre can tell?
    let may_cross = |lo: [usize; 3], cells: usize| {
        let slope = if cells == BRICK { LIPSCHITZ_BRICK } else { LIPSCHITZ };
        let half = lattice.step * cells as f64 * 0.5;
        let centre = lattice.corner([0, 1, 2].map(|k| base[k] + lo[k])) + DVec3::splat(half);
        field(centre).abs() <= half * 1.7321 * slope
    };
    let mut bricks = Vec::new();
    if !may_cross([0; 3], BLOCK) {
        return bricks;
    }
    cache.fill(f32::NAN);
    let mut sample = |c: [usize; 3], from: [usize; 3]| {
        let local = [0, 1, 2].map(|k| from[k] + c[k]);
        let slot = &mut cache[(local[2] * (BLOCK + 1) + local[1]) * (BLOCK + 1) + local[0]];
        if slot.is_nan() {
            *slot = field(lattice.corner([0, 1, 2].map(|k| base[k] + local[k]))) as f32;
        }
        *slot
    };
    let half = BLOCK / 2;
    let quarters: [bool; 8] = std::array::from_fn(|q| may_cross([0, 1, 2].map(|k| half * (q >> k & 1)), half));
    for index in 0..PER_BLOCK.pow(3) {
        let at = [index % PER_BLOCK, index / PER_BLOCK % PER_BLOCK, index / (PER_BLOCK * PER_BLOCK)];
        let from = at.map(|a| a * BRICK);
        let quarter = (0..3).map(|k| (from[k] / half) << k).sum::<usize>();
        if !quarters[quarter] || !may_cross(from, BRICK) {
            continue;
        }
        let brick = read_brick([0, 1, 2].map(|k| block[k] * PER_BLOCK + at[k]), &mut |c| sample(c, from));
        if !brick.offsets.is_empty() {
            bricks.push(brick);
        }
    }
    bricks
}

/// Reads the 5 x 5 x 5 corners of a brick and finds its loops.
fn read_brick(at: [usize; 3], sample: &mut impl FnMut([usize; 3]) -> f32) -> Brick {
    const N: usize = BRICK + 1;
    let values: [f32; N * N * N] = std::array::from_fn(|i| sample([i % N, i / N % N, i / (N * N)]));
    let mut cases = [0; 64];
    let mut offsets = Vec::new();
    for (cell, case) in cases.iter_mut().enumerate() {
        let lo = cell_coordinates(cell);
        let corner: [f32; 8] = std::array::from_fn(|c| {
            let [x, y, z] = [0, 1, 2].map(|k| lo[k] + (c >> k & 1));
            values[(z * N + y) * N + x]
        });
        *case = (0..8).fold(0, |bits, c| bits | u8::from(corner[c] < 0.0) << c);
        if *case != 0 && *case != 255 {
            offsets.extend(loop_centres(&tables().loops[usize::from(*case)][0], *case, &corner));
        }
    }
    Brick { at, cases, flipped: 0, before: [0; 64], first_vertex: 0, offsets }
}

/// Average of the crossings of each loop, in cell units.
fn loop_centres<'a>(loops: &'a Loops, case: u8, values: &'a [f32; 8]) -> impl Iterator<Item = [f32; 3]> + 'a {
    (0..loops.count).map(move |wanted| {
        let mut sum = [0.0; 3];
        let mut crossings = 0.0;
        for edge in 0..12 {
            let [a, b] = edge_corners(edge);
            if (case >> a ^ case >> b) & 1 == 0 || loops.of_edge[edge] != wanted {
                continue;
            }
            let t = values[a] / (values[a] - values[b]);
            for (k, s) in sum.iter_mut().enumerate() {
                let start = (a >> k & 1) as f32;
                *s += start + t * ((b >> k & 1) as f32 - start);
            }
            crossings += 1.0;
        }
        sum.map(|s| s / crossings)
    })
}

fn cell_coordinates(cell: usize) -> [usize; 3] {
    [cell & 3, cell >> 2 & 3, cell >> 4]
}

fn cell_index(at: [usize; 3]) -> usize {
    at[0] | at[1] << 2 | at[2] << 4
}

/// Faces are numbered 2 * axis for the low side and 2 * axis + 1 for the high one.
fn step_through(mut at: [usize; 3], face: usize, limits: [usize; 3]) -> Option<[usize; 3]> {
    let axis = face / 2;
    at[axis] = if face & 1 == 0 { at[axis].checked_sub(1)? } else { at[axis] + 1 };
    (at[axis] < limits[axis]).then_some(at)
}

/// Does the surface cross this face of the brick?
fn surface_leaves(cases: &[u8; 64], face: usize) -> bool {
    let wanted = if face & 1 == 0 { 0 } else { BRICK - 1 };
    (0..64)
        .filter(|&cell| cell_coordinates(cell)[face / 2] == wanted)
        .any(|cell| tables().mixed_faces[usize::from(cases[cell])] >> face & 1 == 1)
}

/// Crossing edges that start at the lowest corner of a cell.
fn owned_edges(cases: &[u8; 64]) -> usize {
    let crossing = |case: u8, axis: u32| usize::from((case ^ case >> (1 << axis)) & 1);
    cases.iter().map(|&case| (0..3).map(|axis| crossing(case, axis)).sum::<usize>()).sum()
}

/// Edges are numbered 4 * axis + place, the place counting the two other coordinates of the start.
fn edge_corners(edge: usize) -> [usize; 2] {
    let (axis, place) = (edge / 4, edge % 4);
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let start = (place & 1) << u | (place >> 1) << v;
    [start, start | 1 << axis]
}

fn edge_index(start: usize, axis: usize) -> usize {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    4 * axis + (start >> u & 1) + 2 * (start >> v & 1)
}

/// Which loop of the cell each crossing edge belongs to.
#[derive(Clone, Copy, Default)]
struct Loops {
    of_edge: [u8; 12],
    count: u8,
}

struct Tables {
    /// Per case: ambiguous faces separate the inside corners, or the same with the problem face resolved otherwise.
    loops: [[Loops; 2]; 256],
    /// The ambiguous face that one loop touches twice, if any; no case has two.
    problem: [Option<usize>; 256],
    /// Per case, a bit for each face with corners on both sides.
    mixed_faces: [u8; 256],
}

fn tables() -> &'static Tables {
    static TABLES: OnceLock<Tables> = OnceLock::new();
    TABLES.get_or_init(|| {
        let mut tables = Tables { loops: [[Loops::default(); 2]; 256], problem: [None; 256], mixed_faces: [0; 256] };
        for case in 0..256 {
            let plain = trace_loops(case, None);
            let ambiguous = |face: usize| {
                let ring = face_ring(face).map(|c| case >> c & 1);
                ring[0] == ring[2] && ring[1] == ring[3] && ring[0] != ring[1]
            };
            let twice =
                |face: usize| face_edges(face).iter().all(|&e| plain.of_edge[e] == plain.of_edge[face_edges(face)[0]]);
            tables.problem[case] = (0..6).find(|&face| ambiguous(face) && twice(face));
            tables.loops[case] = [plain, trace_loops(case, tables.problem[case])];
            tables.mixed_faces[case] = (0..6).fold(0, |bits, face| {
                let inside = face_ring(face).iter().filter(|&&c| case >> c & 1 == 1).count();
                bits | u8::from(inside % 4 != 0) << face
            });
        }
        tables
    })
}

/// The corners of a face in cyclic order.
fn face_ring(face: usize) -> [usize; 4] {
    let (axis, high) = (face / 2, face & 1);
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    [0, 1 << u, 1 << u | 1 << v, 1 << v].map(|c| c | high << axis)
}

/// The edges of a face; edge `i` joins corners `i` and `i + 1` of its ring.
fn face_edges(face: usize) -> [usize; 4] {
    let ring = face_ring(face);
    std::array::from_fn(|i| {
        let (a, b) = (ring[i], ring[(i + 1) % 4]);
        edge_index(a & b, (a ^ b).trailing_zeros() as usize)
    })
}

fn trace_loops(case: usize, inverted: Option<usize>) -> Loops {
    let inside = |corner: usize| case >> corner & 1 == 1;
    let mut label: [usize; 12] = std::array::from_fn(|e| e);
    let mut join = |a: usize, b: usize| {
        let (from, to) = (label[a].max(label[b]), label[a].min(label[b]));
        label.iter_mut().filter(|l| **l == from).for_each(|l| *l = to);
    };
    for face in 0..6 {
        let (ring, edges) = (face_ring(face), face_edges(face));
        let crossing: Vec<usize> = (0..4).filter(|&i| inside(ring[i]) != inside(ring[(i + 1) % 4])).collect();
        match crossing.len() {
            2 => join(edges[crossing[0]], edges[crossing[1]]),
            4 => (0..4)
                .filter(|&i| inside(ring[i]) != (inverted == Some(face)))
                .for_each(|i| join(edges[(i + 3) % 4], edges[i])),
            _ => {}
        }
    }
    let mut loops = Loops::default();
    let mut seen = Vec::new();
    for (edge, label) in label.iter().enumerate() {
        let [a, b] = edge_corners(edge);
        if inside(a) == inside(b) {
            continue;
        }
        let place = seen.iter().position(|l| l == label).unwrap_or_else(|| {
            seen.push(*label);
            seen.len() - 1
        });
        loops.of_edge[edge] = place as u8;
    }
    loops.count = seen.len() as u8;
    loops
}
