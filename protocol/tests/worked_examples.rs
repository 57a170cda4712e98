//! The examples of `PROTOCOL.md`: frames byte by byte, batches step by step, the table of contexts.

use std::path::PathBuf;

use lodestream_protocol::message::ServerMessage;
use lodestream_protocol::op::training::{Decision, Decisions, context_names};
use lodestream_protocol::op::{OpState, decode_base, decode_batch, decode_batch_stepwise};
use lodestream_protocol::wire::{decode_client, decode_server, encode_client, encode_server};

fn text() -> String {
    std::fs::read_to_string(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("PROTOCOL.md")).unwrap()
}

fn golden(name: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/v6/{name}.hex"));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    bytes(&text)
}

fn bytes(hex: &str) -> Vec<u8> {
    let digits: Vec<u8> = hex.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
    let pair = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    digits.chunks(2).map(pair).collect()
}

/// Blocks fenced as "```KIND NAME", as name and lines.
fn blocks(text: &str, kind: &str) -> Vec<(String, Vec<String>)> {
    let mut out: Vec<(String, Vec<String>)> = Vec::new();
    let mut is_inside = false;
    for line in text.lines() {
        match line.strip_prefix("```") {
            Some(info) => {
                let name = info.strip_prefix(kind).and_then(|rest| rest.strip_prefix(' '));
                is_inside = !is_inside && name.is_some();
                out.extend(name.map(|name| (name.to_owned(), Vec::new())));
            }
            None if is_inside => out.last_mut().unwrap().1.push(line.to_owned()),
            None => {}
        }
    }
    out
}

/// The bytes of an annotated frame: on each line what comes before two spaces.
fn annotated(lines: &[String]) -> Vec<u8> {
    lines.iter().flat_map(|line| bytes(line.split("  ").next().unwrap())).collect()
}

#[test]
fn annotated_frames_are_the_golden_ones() {
    let blocks = blocks(&text(), "hex");
    const FROM_CLIENT: [&str; 5] = ["hello", "view", "ack", "reset", "resume"];
    const FROM_SERVER: [&str; 7] = ["welcome", "batch_1", "batch_2", "batch_3", "settled", "restart", "resumed"];
    for name in FROM_CLIENT.into_iter().chain(FROM_SERVER) {
        assert!(blocks.iter().any(|(block, _)| block == name), "no example of {name}");
    }
    for (name, lines) in &blocks {
        let frame = annotated(lines);
        assert_eq!(frame, golden(name), "{name}");
        if FROM_CLIENT.contains(&name.as_str()) {
            assert_eq!(encode_client(&decode_client(&frame).unwrap()), frame, "{name}");
        } else {
            assert_eq!(encode_server(&decode_server(&frame).unwrap()), frame, "{name}");
        }
    }
}

/// The range decoder as `PROTOCOL.md` describes it, given the chances: the dull twin.
struct Coder<'a> {
    bytes: std::iter::Chain<std::slice::Iter<'a, u8>, std::iter::Repeat<&'a u8>>,
    range: u64,
    code: u64,
}

impl<'a> Coder<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        let mut coder = Self { bytes: bytes.iter().chain(std::iter::repeat(&0)), range: 0xffff_ffff, code: 0 };
        (0..4).for_each(|_| coder.shift());
        coder
    }

    fn shift(&mut self) {
        self.code = self.code * 256 + u64::from(*self.bytes.next().unwrap());
    }

    fn normalize(&mut self) {
        while self.range < 1 << 24 {
            self.range *= 256;
            self.shift();
        }
    }

    fn bit(&mut self, zero: u32) -> bool {
        let bound = (self.range / 65_536) * u64::from(zero);
        let bit = self.code >= bound;
        if bit {
            (self.code, self.range) = (self.code - bound, self.range - bound);
        } else {
            self.range = bound;
        }
        self.normalize();
        bit
    }

    fn raw(&mut self, count: u32) -> u32 {
        self.range >>= count;
        let value = self.code / self.range;
        self.code -= value * self.range;
        self.normalize();
        value as u32
    }
}

/// The steps of the golden batches, one line each, as decoded by the codec and again by the twin.
fn steps_of_batches() -> Vec<(String, Vec<String>)> {
    let ServerMessage::Welcome { base, model, cache_entries, .. } = decode_server(&golden("welcome")).unwrap() else {
        panic!("the welcome is no welcome");
    };
    let base = decode_base(&base, model.lattice.bits, model.has_colors).unwrap();
    let mut state = OpState::new(&base, model.lattice.bits, model.has_colors, model.has_moves, cache_entries).unwrap();
    let mut limit = 0;
    let mut out = Vec::new();
    for name in ["batch_1", "batch_2", "batch_3"] {
        let ServerMessage::Batch(batch) = decode_server(&golden(name)).unwrap() else { panic!("{name} is no batch") };
        limit = batch.limit.unwrap_or(limit);
        let mut untraced = state.clone();
        decode_batch(&batch.ops, &mut untraced, limit).unwrap();
        let mut decisions = Decisions::default();
        decode_batch_stepwise(&batch.ops, &mut state, limit, &mut decisions).unwrap();
        assert_eq!(state.replica().digest(), untraced.replica().digest());
        let mut coder = Coder::new(&batch.ops);
        let mut lines = Vec::new();
        for (i, step) in decisions.steps.iter().enumerate() {
            let (range, code) = (coder.range, coder.code);
            let what = match step {
                Decision::Bit { context, zero, bit } => {
                    assert_eq!(coder.bit(*zero), *bit, "{name}, step {i}");
                    format!("{zero:>5}  {}  {context}", u8::from(*bit))
                }
                Decision::Raw { value, count } => {
                    assert_eq!(coder.raw(*count), *value, "{name}, step {i}");
                    format!("  raw  {value}  {count} bits")
                }
            };
            lines.push(format!("{:>3}  {range:08x}  {code:08x}  {what}", i + 1));
        }
        out.push((name.to_owned(), lines));
    }
    out
}

/// Blocks "```steps NAME": lines of which the part before " <- " must be as coded; "..." skips lines.
#[test]
fn steps_are_as_coded() {
    let blocks = blocks(&text(), "steps");
    assert!(blocks.iter().map(|block| &block.0).eq(["batch_1", "batch_2", "batch_3"].iter()), "a batch has no steps");
    for ((name, lines), (_, coded)) in blocks.iter().zip(steps_of_batches()) {
        assert!(lines.len() > 5, "{name}");
        for line in lines.iter().filter(|line| *line != "...") {
            let line = line.split(" <- ").next().unwrap().trim_end();
            assert!(coded.iter().any(|coded| coded == line), "{name}: {line:?} is not among\n{}", coded.join("\n"));
        }
    }
}

/// The tables of contexts: rows "| first | name | count | ... |".
#[test]
fn the_tables_list_all_contexts_in_order() {
    let text = text();
    for (heading, names) in ["| first batch context |", "| first patch context |"].into_iter().zip(context_names()) {
        let rows: Vec<Vec<&str>> = text
            .lines()
            .skip_while(|line| !line.starts_with(heading))
            .skip(2)
            .take_while(|line| line.starts_with('|'))
            .map(|line| line.split('|').map(|cell| cell.trim().trim_matches('`')).collect())
            .collect();
        let mut next = 0;
        for row in &rows {
            let (first, name, count): (usize, &str, usize) = (row[1].parse().unwrap(), row[2], row[3].parse().unwrap());
            assert_eq!(first, next, "{name}");
            for full in &names[first..first + count] {
                assert_eq!(stem(full), name, "{full}");
            }
            next += count;
        }
        assert_eq!(next, names.len(), "{heading}");
    }
}

/// A name without indices and without what it is within a model.
fn stem(name: &str) -> String {
    let inner = [".length", ".mantissa", ".sign", ".by_size", "by_bend"];
    let end = inner.iter().filter_map(|part| name.find(part)).min().unwrap_or(name.len());
    name[..end]
        .trim_end_matches('.')
        .split('[')
        .map(|part| part.split_once(']').map_or(part, |(_, rest)| rest))
        .collect()
}

/// What the tables and steps of `PROTOCOL.md` are to say.
#[test]
#[ignore = "prints"]
fn print_examples() {
    for names in context_names() {
        let mut first = 0;
        for run in names.chunk_by(|a, b| stem(a) == stem(b)) {
            println!("| {first} | `{}` | {} |", stem(&run[0]), run.len());
            first += run.len();
        }
    }
    for (name, lines) in steps_of_batches() {
        println!("{name}\n{}", lines.join("\n"));
    }
}
