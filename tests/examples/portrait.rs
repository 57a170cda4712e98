//! Draws the generated sample: `cargo run --release -p lodestream-tests --example portrait -- TRIANGLES SEED OUT.png
//! [X,Y,Z [ZOOM]]`, seen from direction X,Y,Z.

use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use glam::{DMat4, DVec3};
use lodestream_server::ingest::sample;
use lodestream_tests::raster::{RasterOptions, framing, render};

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let arg = |i: usize, default: &str| args.get(i).map_or(default, String::as_str).to_owned();
    let start = Instant::now();
    let mesh = sample::generate(arg(0, "500000").parse()?, arg(1, "0").parse()?);
    println!("{} triangles in {:.2?}", mesh.faces.len(), start.elapsed());
    let direction: Vec<f64> = arg(3, "0.35,0.25,1").split(',').map(str::parse).collect::<Result<_, _>>()?;
    let direction = DVec3::from_array(direction.try_into().ok().context("three coordinates")?);
    let zoom: f64 = arg(4, "1").parse()?;
    let bounds = mesh.bounding_box().context("empty mesh")?;
    let (width, height) = (1280, 720);
    let view_projection = DMat4::from_scale(DVec3::new(zoom, zoom, 1.0)) * framing(bounds, direction, 16.0 / 9.0);
    let options = RasterOptions { width, height, view_projection, smooth: true, two_sided: false };
    render(&(&mesh).into(), &options).write_png(Path::new(&arg(2, "sample.png")))
}
