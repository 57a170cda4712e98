//! The commands of `lodestream-server`, one file each.
//!
//! Results go to standard output; progress, logs and errors to standard error. Exit codes: 0 done, 1 failed, 2 usage.

/// Prints a line of results, like `println!` but for errors: those go to the caller, and a reader who has gone away is none.
macro_rules! say {
    ($($text:tt)*) => {
        $crate::cli::say_line(format_args!($($text)*))?
    };
}

pub mod choice;
pub mod demo;
pub mod export;
pub mod ingest;
pub mod inspect;
pub mod progress;
pub mod sample;
pub mod screen_error;
pub mod serve;
mod usage;
pub mod verify;

use std::io::Write as _;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Hosts a repository of huge triangle meshes and streams the detail that each viewer can see.
#[derive(Debug, Parser)]
#[command(name = "lodestream-server", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Ingest(ingest::IngestArgs),
    Serve(serve::ServeArgs),
    Inspect(inspect::InspectArgs),
    Verify(verify::VerifyArgs),
    Export(export::ExportArgs),
    ScreenError(screen_error::ScreenErrorArgs),
    Sample(sample::SampleArgs),
    Demo(demo::DemoArgs),
}

/// Arguments that parse one by one but make no sense together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// See `say!`.
fn say_line(text: std::fmt::Arguments<'_>) -> std::io::Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        // Such as `head`, which has read what it wanted.
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

/// The id of a model as given on the command line.
fn model_id(text: &str) -> Result<crate::repository::ModelId, UsageError> {
    text.parse().map_err(|error| UsageError(format!("`{text}`: {error}")))
}

/// Parses the command line and runs the command.
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Ingest(args) => ingest::run(args),
        Command::Serve(args) => serve::run(args),
        Command::Inspect(args) => inspect::run(args),
        Command::Verify(args) => verify::run(args),
        Command::Export(args) => export::run(args),
        Command::ScreenError(args) => screen_error::run(args),
        Command::Sample(args) => sample::run(args),
        Command::Demo(args) => demo::run(args),
    };
    let Err(error) = result else {
        return ExitCode::SUCCESS;
    };
    // Nothing is left to do when even this cannot be written.
    let _ = writeln!(std::io::stderr(), "error: {}", one_line(&error));
    ExitCode::from(if error.is::<UsageError>() { 2 } else { 1 })
}

/// An error with its causes, without repeating a cause that its effect already quotes.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if line.is_empty() {
            line = cause;
        } else if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    line.replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::anyhow;
    use clap::CommandFactory as _;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn errors_take_one_line() {
        let error = anyhow!("no such file").context("cannot read a.ply").context("a.ply: cannot read a.ply");
        assert_eq!(one_line(&error), "a.ply: cannot read a.ply: no such file");
        assert_eq!(one_line(&anyhow!("one\ntwo")), "one two");
    }
}
