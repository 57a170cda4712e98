//! `lodestream-server`: see [`lodestream_server::cli`].

fn main() -> std::process::ExitCode {
    lodestream_server::cli::main()
}
