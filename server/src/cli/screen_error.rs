//! `screen-error`: how far a mesh strays from another, as seen in one view.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use glam::DVec3;
use lodestream_protocol::view::View;

use super::UsageError;
use super::progress::ProgressLine;
use crate::ingest::read::read_mesh_in_memory;
use crate::judge::original::Original;
use crate::judge::screen_error::{Candidate, screen_error};
use crate::mesh::TriMesh;

/// Measure how far a mesh strays from the original in a view, in pixels.
///
/// For each vertex of the original that faces the camera and lies in the picture: its distance to the mesh, times
/// height / (2 tan(fov / 2)), over its depth along the view. Right-handed, y up.
#[derive(Clone, Debug, clap::Args)]
pub struct ScreenErrorArgs {
    /// File of the original mesh.
    pub original: PathBuf,
    /// File of the mesh to judge.
    pub mesh: PathBuf,
    /// Width and height of the picture in pixels.
    #[arg(long, value_name = "WxH", value_parser = size)]
    pub size: (u32, u32),
    /// Where the camera is, in model units.
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub eye: DVec3,
    /// What it looks at.
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub target: DVec3,
    /// Vertical opening angle in degrees.
    #[arg(long, value_name = "DEG", value_parser = angle)]
    pub fov: f32,
    /// Judge what faces away, too: for open surfaces.
    #[arg(long)]
    pub two_sided: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
}

fn size(text: &str) -> Result<(u32, u32), String> {
    let (width, height) = text.split_once('x').ok_or("not of the form WxH")?;
    let number = |text: &str| text.parse().ok().filter(|n| (1..=1 << 20).contains(n));
    number(width).zip(number(height)).ok_or_else(|| "width and height are 1 to 1048576".into())
}

fn point(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|part| part.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
    match numbers.as_deref() {
        Some(&[x, y, z]) => Ok(DVec3::new(x, y, z)),
        _ => Err("not three numbers X,Y,Z".into()),
    }
}

fn angle(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|x| *x > 0.0 && *x < 180.0).ok_or_else(|| "not between 0 and 180 degrees".into())
}

/// Reads both meshes, judges, prints.
///
/// # Errors
/// A file that cannot be used, a camera that looks nowhere.
pub fn run(args: ScreenErrorArgs) -> anyhow::Result<()> {
    if args.eye == args.target {
        return Err(UsageError("--eye and --target are the same point".into()).into());
    }
    let mut view = View::perspective(args.eye, args.target, args.fov.to_radians());
    view.aspect = args.size.0 as f32 / args.size.1 as f32;
    view.viewport_height_px = args.size.1;
    view.two_sided = args.two_sided;
    // Far below any distance of interest: only what lies behind the camera is out.
    view.near = args.eye.distance(args.target) * 1e-6;
    view.validate().map_err(|error| UsageError(error.to_string()))?;
    let progress = ProgressLine::new(!args.json);
    progress.show("read", 0, None);
    let (original, mesh) = (read(&args.original)?, read(&args.mesh)?);
    let error = screen_error(&Original::new(&original), &Candidate::new(&mesh), &view);
    drop(progress);
    if args.json {
        let mut line = serde_json::to_value(error)?;
        line["original_triangles"] = original.faces.len().into();
        line["mesh_triangles"] = mesh.faces.len().into();
        say!("{line}");
        return Ok(());
    }
    for (name, p) in [("unoccluded", &error.unoccluded), ("front-facing", &error.front_facing)] {
        say!(
            "{name:<13} {} vertices: p50 {:.3}  p99 {:.3}  p99.9 {:.3}  maximum {:.3} px",
            p.vertices,
            p.p50,
            p.p99,
            p.p999,
            p.max
        );
    }
    if let Some(color) = &error.color {
        say!("colour        mean {:.2} %, maximum {:.1} % of full scale", 100.0 * color.mean, 100.0 * color.max);
    }
    Ok(())
}

fn read(path: &Path) -> anyhow::Result<TriMesh> {
    let (mesh, _) = read_mesh_in_memory(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_parse() {
        assert_eq!(size("1920x1080"), Ok((1920, 1080)));
        assert_eq!(point("-1, 2.5,3e2"), Ok(DVec3::new(-1.0, 2.5, 300.0)));
        assert_eq!(angle("45"), Ok(45.0));
        for bad in ["", "5", "0x5", "1x-1", "axb"] {
            assert!(size(bad).is_err(), "{bad}");
        }
        for bad in ["1,2", "1,2,3,4", "a,b,c", "inf,0,0", "NaN,0,0"] {
            assert!(point(bad).is_err(), "{bad}");
        }
        for bad in ["0", "180", "NaN", "x"] {
            assert!(angle(bad).is_err(), "{bad}");
        }
    }
}
