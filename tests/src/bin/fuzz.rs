//! Runs the fuzz targets for some seconds each: `fuzz [--seconds S] [--target NAME] [--seed N]`.
//!
//! A case that panics prints its seed; `--target NAME --seed N` runs that case alone.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use fastrand::Rng;
use lodestream_tests::fuzz::targets;

/// A case that takes longer than this counts as a hang.
const SLOW: Duration = Duration::from_secs(5);

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let value = |flag: &str| args.iter().position(|a| a == flag).and_then(|i| args.get(i + 1));
    let seconds: f64 = value("--seconds").and_then(|s| s.parse().ok()).unwrap_or(10.0);
    let only = value("--target");
    let seed: Option<u64> = value("--seed").and_then(|s| s.parse().ok());
    let mut failed = 0;
    for target in targets() {
        if only.is_some_and(|name| name != target.name) {
            continue;
        }
        let start = Instant::now();
        let mut cases = 0u64;
        while seed.is_none() && start.elapsed().as_secs_f64() < seconds || seed.is_some() && cases == 0 {
            let case = seed.unwrap_or(cases);
            let began = Instant::now();
            let run = std::panic::AssertUnwindSafe(|| (target.run)(&mut Rng::with_seed(case)));
            if std::panic::catch_unwind(run).is_err() {
                println!("{}: panic, again with --target {} --seed {case}", target.name, target.name);
                failed += 1;
                break;
            }
            if began.elapsed() > SLOW {
                println!("{}: {:?} for one case, --seed {case}", target.name, began.elapsed());
                failed += 1;
                break;
            }
            cases += 1;
        }
        println!("{}: {cases} cases", target.name);
    }
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
