//! What a pack holds, for people and as JSON.

use std::fmt;
use std::num::NonZeroU16;

use lodestream_protocol::quant::Lattice;
use serde::Serialize;

use super::layout::{Section, UNKNOWN_NAME, VERSION};
use super::record::Magnitude;
use super::{Metadata, PackError, PackedModel, parents_first};

/// Length of one section.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SectionSize {
    /// Name as in error messages.
    pub name: &'static str,
    /// Bytes without padding.
    pub bytes: u64,
}

/// A description of a model and its pack.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// Title, licence, source, reports.
    pub metadata: Metadata,
    /// Hash of the complete mesh, in hexadecimal.
    pub hash: String,
    /// Version of the pack's layout.
    pub version: u32,
    /// Vertices of the complete mesh.
    pub vertices: u64,
    /// Triangles of the complete mesh.
    pub triangles: u64,
    /// The lattice of all positions.
    pub lattice: Lattice,
    /// Sides of the box in model units.
    pub extent: [f64; 3],
    /// What vertices have: `position`, and `color` if they have colours.
    pub attributes: Vec<&'static str>,
    /// Whether vertices have colours.
    pub has_colors: bool,
    /// Whether splits may move the vertex that they split.
    pub has_moves: bool,
    /// Two coordinates of most vertices are multiples of this, in lattice steps: `visual` precision.
    pub visual_step: Option<NonZeroU16>,
    /// Whether the inside of the surface can be seen.
    pub is_open: bool,
    /// Vertices of the base.
    pub base_vertices: u32,
    /// Triangles of the base.
    pub base_triangles: u32,
    /// Smallest triangle limit that a view may ask for, which is the base.
    pub smallest_limit: u32,
    /// Components that spawn.
    pub spawns: u32,
    /// Vertex splits.
    pub splits: u32,
    /// Smallest error of an op that is not zero, and the largest, in model units; zeros without such ops.
    pub error_range: [f64; 2],
    /// Ops with an error of exactly zero.
    pub zero_errors: u64,
    /// Ops on the longest chain of parents.
    pub dag_depth: u32,
    /// How many splits wait for 0, 1, 2, 3 others, and so on as far as there are any.
    pub parents_histogram: Vec<u64>,
    /// Length of the pack.
    pub bytes: u64,
    /// Bytes of op pages and their directory per op.
    pub bytes_per_split: f64,
    /// Length of each section, in file order.
    pub sections: Vec<SectionSize>,
}

/// Describes a pack. Goes through all ops, about 0.1 us each, and checks the pages on the way.
///
/// # Errors
/// [`PackError`] if a page is damaged.
pub fn inspect(model: &PackedModel) -> Result<Inspection, PackError> {
    let info = model.info();
    let (mut smallest, mut largest, mut zero_errors) = (u16::MAX, 0, 0);
    for page in 0..model.page_count() {
        for &error in model.tests(page)?.error {
            largest = error.max(largest);
            if error == 0 {
                zero_errors += 1;
            } else {
                smallest = error.min(smallest);
            }
        }
    }
    let mut depth = vec![0u32; model.op_count() as usize];
    depth[..model.spawn_count() as usize].fill(1);
    let mut parents_histogram = vec![0; 4];
    parents_first(model, |op, parents| {
        depth[op as usize] = 1 + parents.iter().map(|&p| depth[p as usize]).max().unwrap_or(0);
        if parents_histogram.len() <= parents.len() {
            parents_histogram.resize(parents.len() + 1, 0);
        }
        parents_histogram[parents.len()] += 1;
        Ok(())
    })?;
    let sections: Vec<SectionSize> = model
        .sections()
        .iter()
        .map(|(section, entry)| SectionSize { name: section.map_or(UNKNOWN_NAME, Section::name), bytes: entry.bytes })
        .collect();
    let in_pages = |s: &&SectionSize| s.name == Section::OpPages.name() || s.name == Section::OpDirectory.name();
    let page_bytes: u64 = sections.iter().filter(in_pages).map(|s| s.bytes).sum();
    let error_of = |m: u16| f64::from(Magnitude(m).decode()) * info.lattice.step;
    Ok(Inspection {
        metadata: model.metadata().clone(),
        hash: format!("{:016x}", info.hash.0),
        version: VERSION,
        vertices: info.vertices,
        triangles: info.triangles,
        lattice: info.lattice,
        extent: std::array::from_fn(|k| f64::from(info.box_max[k] - info.box_min[k]) * info.lattice.step),
        attributes: if info.has_colors { vec!["position", "color"] } else { vec!["position"] },
        has_colors: info.has_colors,
        has_moves: info.has_moves,
        visual_step: info.visual_step,
        is_open: info.is_open,
        base_vertices: model.base().positions.len() as u32,
        base_triangles: model.base().faces.len() as u32,
        smallest_limit: info.smallest_limit,
        spawns: model.spawn_count(),
        splits: model.op_count() - model.spawn_count(),
        error_range: [smallest.min(largest), largest].map(error_of),
        zero_errors,
        dag_depth: depth.into_iter().max().unwrap_or(0),
        parents_histogram,
        bytes: model.file_bytes(),
        bytes_per_split: page_bytes as f64 / f64::from(model.op_count().max(1)),
        sections,
    })
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut line = |name: &str, value: String| writeln!(f, "{name:<16} {value}");
        let or_dash = |text: &str| if text.is_empty() { "-".to_string() } else { text.to_string() };
        let [x, y, z] = self.extent;
        let attributes =
            [(self.has_colors, "colours"), (self.has_moves, "moving placements"), (self.is_open, "open surface")];
        let attributes: Vec<&str> = attributes.iter().filter(|(on, _)| *on).map(|&(_, name)| name).collect();
        let parents = self.parents_histogram.iter().enumerate().map(|(count, splits)| format!("{count}: {splits}"));
        line("title", or_dash(&self.metadata.title))?;
        line("licence", or_dash(&self.metadata.license))?;
        line("source", or_dash(&self.metadata.source))?;
        if !self.metadata.original.is_empty() {
            line("original", self.metadata.original.clone())?;
        }
        line("hash", self.hash.clone())?;
        line("complete mesh", format!("{} triangles, {} vertices", self.triangles, self.vertices))?;
        line("extent", format!("{x} x {y} x {z}"))?;
        line("lattice", format!("{} bits, step {:e}", self.lattice.bits, self.lattice.step))?;
        if let Some(step) = self.visual_step {
            let moved = &self.metadata.build_report["resampled"]["largest"];
            let moved = moved.as_f64().map_or(String::new(), |far| format!(", vertices moved by {far:.1} at most"));
            line("precision", format!("visual, in {step} lattice steps across{moved}"))?;
        }
        line("attributes", or_dash(&attributes.join(", ")))?;
        line("base", format!("{} triangles, {} vertices", self.base_triangles, self.base_vertices))?;
        line("smallest limit", format!("{} triangles", self.smallest_limit))?;
        line("operations", format!("{} splits, {} spawns", self.splits, self.spawns))?;
        let [smallest, largest] = self.error_range;
        line("errors", format!("{smallest:e} to {largest:e}, and {} of zero", self.zero_errors))?;
        line("depth", format!("{} operations", self.dag_depth))?;
        line("parents", parents.collect::<Vec<_>>().join(", "))?;
        line(
            "pack",
            format!("version {}, {} bytes, {:.1} bytes per split", self.version, self.bytes, self.bytes_per_split),
        )?;
        line("written by", or_dash(&self.metadata.created_by))?;
        for section in &self.sections {
            line(&format!("  {}", section.name), format!("{} bytes", section.bytes))?;
        }
        let reports = [&self.metadata.read_report, &self.metadata.clean_report, &self.metadata.build_report];
        for (name, report) in ["read", "clean", "build"].into_iter().zip(reports) {
            if !report.is_null() {
                line(&format!("{name} report"), report.to_string())?;
            }
        }
        Ok(())
    }
}
