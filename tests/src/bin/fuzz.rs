//! Runs the fuzz targets for some seconds each: `fuzz [--seconds S | --cases N] [--readers] [--target NAME] [--seed N | --first N]`.
//!
//! `--readers` runs the readers of mesh files alone. A case that panics prints its seed; `--target NAME --seed N` runs that
//! case alone. A reader fails, too, when it takes more memory than the length of its file allows.

use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use fastrand::Rng;
use lodestream_tests::fuzz::{FRAMES, Target, readers, targets};
use peak_alloc::PeakAlloc;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// A case that takes longer than this counts as a hang.
const SLOW: Duration = Duration::from_secs(5);

/// Memory that a reader may take for each byte of its file.
const BYTES_PER_BYTE: usize = 64;

/// Memory that it may take for any file: buffers, tables of decoders.
const BYTES_FOR_ANY: usize = 4 << 20;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let value = |flag: &str| args.iter().position(|a| a == flag).and_then(|i| args.get(i + 1));
    let cases: Option<u64> = value("--cases").and_then(|s| s.parse().ok());
    let seconds: f64 = value("--seconds").and_then(|s| s.parse().ok()).unwrap_or(10.0);
    let only = value("--target");
    let seed: Option<u64> = value("--seed").and_then(|s| s.parse().ok());
    let first: u64 = value("--first").and_then(|s| s.parse().ok()).unwrap_or(0);
    let all = if args.iter().any(|a| a == "--readers") { readers() } else { targets() };
    let mut failed = 0;
    for target in all {
        if only.is_some_and(|name| name != target.name) {
            continue;
        }
        let start = Instant::now();
        let frames = FRAMES.load(Ordering::Relaxed);
        let goes_on = |done: u64| match (seed, cases) {
            (Some(_), _) => done == 0,
            (None, Some(cases)) => done < cases,
            (None, None) => start.elapsed().as_secs_f64() < seconds,
        };
        let (mut done, mut peak) = (0, 0);
        while goes_on(done) {
            let case = seed.unwrap_or(first + done);
            match run(&target, case) {
                Ok(memory) => peak = peak.max(memory),
                Err(problem) => {
                    println!("{}: {problem}, again with --target {} --seed {case}", target.name, target.name);
                    failed += 1;
                    break;
                }
            }
            done += 1;
        }
        let seconds = start.elapsed().as_secs_f64();
        let of_frames = match FRAMES.load(Ordering::Relaxed) - frames {
            0 => String::new(),
            frames => format!(" of {frames} frames"),
        };
        println!("{}: {done} cases{of_frames} in {seconds:.0} s, at most {} KiB at once", target.name, peak >> 10);
    }
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs one case and gives the most memory that it took.
fn run(target: &Target, case: u64) -> Result<usize, String> {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let began = Instant::now();
    let run = std::panic::AssertUnwindSafe(|| (target.run)(&mut Rng::with_seed(case)));
    let len = std::panic::catch_unwind(run).map_err(|_| "panic".to_owned())?;
    if began.elapsed() > SLOW {
        return Err(format!("{:?} for one case", began.elapsed()));
    }
    let memory = MEMORY.peak_usage().saturating_sub(before);
    let Some(len) = len else { return Ok(memory) };
    if memory > BYTES_PER_BYTE * len + BYTES_FOR_ANY {
        return Err(format!("{memory} bytes of memory for {len} bytes of file"));
    }
    Ok(memory)
}
