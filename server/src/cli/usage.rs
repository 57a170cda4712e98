//! What this process has used so far, where the system tells: Linux.

use serde::Serialize;

/// Processor time and memory.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct Usage {
    /// Processor time of all threads, in seconds; `None` where it is not known.
    pub(super) cpu_seconds: Option<f64>,
    /// Most memory ever held at once (resident), in bytes; `None` where it is not known.
    pub(super) peak_memory_bytes: Option<u64>,
}

impl Usage {
    /// As of now.
    pub(super) fn now() -> Self {
        let read = |path: &str| std::fs::read_to_string(path).ok();
        Self {
            cpu_seconds: read("/proc/self/stat").and_then(|stat| cpu_seconds(&stat)),
            peak_memory_bytes: read("/proc/self/status").and_then(|status| peak_memory_bytes(&status)),
        }
    }
}

/// Fields 14 and 15 of proc(5) `stat`, in hundredths of a second on every Linux that Rust runs on. The second field, the
/// name, is in parentheses and may hold anything.
fn cpu_seconds(stat: &str) -> Option<f64> {
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<u64>().ok();
    Some((ticks()? + ticks()?) as f64 / 100.0)
}

fn peak_memory_bytes(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fields_are_found() {
        let stat = "42 (a b) c) R 1 2 3 4 5 6 7 8 9 10 150 25 0 0 20";
        assert_eq!(cpu_seconds(stat), Some(1.75));
        assert_eq!(peak_memory_bytes("Name:\tx\nVmHWM:\t   2048 kB\nVmRSS:\t 1 kB\n"), Some(2048 * 1024));
        assert_eq!((cpu_seconds("42"), peak_memory_bytes("VmHWM: many")), (None, None));
    }
}
