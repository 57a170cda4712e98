//! What long commands show while they work: stage, rate and time left on a terminal, nothing elsewhere.

use std::io::IsTerminal as _;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// One line on standard error that follows the stages of a command and is gone when the command is done. Any thread may call it.
#[derive(Debug)]
pub struct ProgressLine {
    bar: ProgressBar,
    stage: Mutex<String>,
}

impl ProgressLine {
    /// A line that is shown if standard error is a terminal and `is_wanted` (no `--json`).
    pub fn new(is_wanted: bool) -> Self {
        let target = if is_wanted && std::io::stderr().is_terminal() {
            ProgressDrawTarget::stderr_with_hz(8)
        } else {
            ProgressDrawTarget::hidden()
        };
        Self { bar: ProgressBar::with_draw_target(None, target), stage: Mutex::default() }
    }

    /// Shows that `done` of `total` are done in `stage`; `total` is `None` while it is unknown. Cheap enough to be called
    /// for every thousand steps.
    pub fn show(&self, stage: &str, done: u64, total: Option<u64>) {
        let mut shown = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        if *shown != stage {
            stage.clone_into(&mut shown);
            self.bar.reset();
            self.bar.set_style(style(total.is_some()));
            self.bar.set_message(stage.to_owned());
            self.bar.enable_steady_tick(Duration::from_millis(250));
        }
        if let Some(total) = total {
            self.bar.set_length(total);
        }
        self.bar.set_position(done);
    }

    /// Prints a line above this one.
    pub fn note(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }
}

impl Drop for ProgressLine {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

fn style(has_total: bool) -> ProgressStyle {
    let template = if has_total {
        "{msg:<12} {wide_bar} {human_pos}/{human_len} {per_sec} {eta} left"
    } else {
        "{msg:<12} {spinner} {human_pos} {per_sec} {elapsed}"
    };
    ProgressStyle::with_template(template).expect("the templates above are valid")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_follow_each_other() {
        let line = ProgressLine::new(false);
        line.show("read", 10, None);
        line.show("simplify", 1, Some(100));
        assert_eq!((line.bar.position(), line.bar.length()), (1, Some(100)));
    }
}
