//! Runs random sessions until so many ops have crossed: `soak [OPS] [--threads N] [--from NUMBER | --only NUMBER]`.
//!
//! Progress goes to stderr; the last line of stdout is JSON with `ops`, `sessions` and `mismatches`. A session that fails
//! prints its number; `--only NUMBER` runs that one alone.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use lodestream_tests::soak::{Done, Soak};

const USAGE: &str = "usage: soak [OPS] [--threads N] [--from NUMBER | --only NUMBER]";
const PROGRESS: Duration = Duration::from_secs(10);

struct Options {
    ops: u64,
    threads: usize,
    from: u64,
    only: Option<u64>,
}

fn options() -> Option<Options> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut options = Options { ops: 10_000_000, threads, from: 0, only: None };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--threads" => options.threads = args.next()?.parse().ok().filter(|&n| n > 0)?,
            "--from" => options.from = args.next()?.parse().ok()?,
            "--only" => options.only = Some(args.next()?.parse().ok()?),
            _ => options.ops = arg.parse().ok()?,
        }
    }
    Some(options)
}

#[derive(Default)]
struct Totals {
    done: Done,
    sessions: u64,
    mismatches: u64,
}

fn main() -> ExitCode {
    let Some(options) = options() else {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    };
    let soak = Soak::new(false);
    if let Some(number) = options.only {
        println!("{:?}", soak.run(number));
        return ExitCode::SUCCESS;
    }
    let start = Instant::now();
    let next = AtomicU64::new(options.from);
    let totals = Mutex::new((Totals::default(), Duration::ZERO));
    std::thread::scope(|scope| {
        for _ in 0..options.threads {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let result = catch_unwind(AssertUnwindSafe(|| soak.run(number)));
                    let (totals, reported) = &mut *totals.lock().expect("no thread panics here");
                    totals.sessions += 1;
                    match result {
                        Ok(done) => totals.done += done,
                        Err(_) => {
                            totals.mismatches += 1;
                            eprintln!("session {number} failed, again with --only {number}");
                        }
                    }
                    let elapsed = start.elapsed();
                    if elapsed > *reported + PROGRESS {
                        *reported = elapsed;
                        progress(totals, elapsed);
                    }
                    // Where hardly a session succeeds, more of them tell nothing new.
                    if totals.done.ops >= options.ops || totals.mismatches > 100 {
                        break;
                    }
                }
            });
        }
    });
    let (totals, _) = totals.into_inner().expect("no thread panics here");
    progress(&totals, start.elapsed());
    let Totals { done, sessions, mismatches } = totals;
    let Done { ops, batches, meshes } = done;
    println!(
        "{}",
        serde_json::json!({
            "ops": ops, "sessions": sessions, "batches": batches, "meshes": meshes, "mismatches": mismatches
        })
    );
    if mismatches == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn progress(totals: &Totals, elapsed: Duration) {
    let ops = totals.done.ops;
    let rate = ops as f64 / elapsed.as_secs_f64().max(1e-9);
    let Totals { sessions, mismatches, .. } = totals;
    eprintln!(
        "{:5.0} s: {ops} ops in {sessions} sessions, {rate:.0} ops/s, {mismatches} mismatches",
        elapsed.as_secs_f64()
    );
}
