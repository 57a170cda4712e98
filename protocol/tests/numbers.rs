//! `docs/protocol-v6-numbers.json`: the trained numbers of the protocol as data, for clients in other languages.

use std::fmt::Write as _;
use std::path::PathBuf;

use lodestream_protocol::message::PROTOCOL_VERSION;
use lodestream_protocol::op::training::context_names;
use lodestream_protocol::op::{ArcWeights, SizeWeights, TRAINED};

fn path() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../docs/protocol-v6-numbers.json")
}

fn list<T: ToString>(items: &[T]) -> String {
    format!("[{}]", items.iter().map(T::to_string).collect::<Vec<_>>().join(", "))
}

fn rows<T>(items: &[T], indent: &str, row: impl Fn(&T) -> String) -> String {
    let rows: Vec<String> = items.iter().map(|item| format!("{indent}  {}", row(item))).collect();
    format!("[\n{}\n{indent}]", rows.join(",\n"))
}

/// The start of each context, even odds where the table ends early.
fn starts(names: &[String], priors: &[u16]) -> String {
    assert!(priors.len() <= names.len(), "more trained starts than contexts");
    let all: Vec<u16> = (0..names.len()).map(|i| priors.get(i).copied().unwrap_or(1 << 15)).collect();
    let lines: Vec<String> = all
        .chunks(20)
        .map(|line| format!("    {}", line.iter().map(u16::to_string).collect::<Vec<_>>().join(", ")))
        .collect();
    format!("[\n{}\n  ]", lines.join(",\n"))
}

fn numbers() -> String {
    let mut out = String::from("{\n");
    let mut put = |key: &str, value: String| writeln!(out, "  \"{key}\": {value},").unwrap();
    put("protocol", PROTOCOL_VERSION.to_string());
    let arc = |w: &ArcWeights| list(&[w.cut_length, w.inner_length, w.edge_length, w.area, w.area_squared]);
    put("arcs", rows(&TRAINED.cut.arcs, "  ", arc));
    put("position", rows(&TRAINED.position, "  ", |row| list(row)));
    let size = |size: &SizeWeights| {
        format!("{{ \"constant\": {}, \"features\": {} }}", list(&size.constant), list(&size.features))
    };
    put("tangent_size", size(&TRAINED.tangent_size));
    put("height_size", size(&TRAINED.height_size));
    let [batch, patch] = context_names();
    put("contexts", starts(&batch, TRAINED.priors));
    writeln!(out, "  \"patch_contexts\": {}\n}}", starts(&patch, TRAINED.patch_priors)).unwrap();
    out
}

#[test]
fn the_file_holds_what_the_codec_is_built_with() {
    let text = std::fs::read_to_string(path()).expect("the file of the trained numbers");
    assert!(text == numbers(), "{} differs from the trained table", path().display());
}

/// To be run when the table was trained anew, which takes a new version of the protocol.
#[test]
#[ignore = "writes the file"]
fn write_numbers() {
    std::fs::write(path(), numbers()).unwrap();
}
