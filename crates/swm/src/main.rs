//! The `swm` command.

use clap::Parser as _;

fn main() -> std::process::ExitCode {
    swm::cli::Cli::parse().run().into()
}
