//! The `swm` command.

fn main() -> std::process::ExitCode {
    swm::cli::run(std::env::args_os()).into()
}
