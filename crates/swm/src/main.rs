//! The `swm` command.

mod allocator;
mod open_output;

use std::io::Write as _;

#[global_allocator]
static ALLOCATOR: allocator::Allocator = allocator::Allocator;

fn main() -> std::process::ExitCode {
    if !open_output::is_open() {
        let error = b"error: standard output is closed; redirect it to a file, or to /dev/null to drop the output\n";
        std::io::stderr().write_all(error).ok();
        return std::process::ExitCode::FAILURE;
    }
    swm::cli::run(std::env::args_os()).into()
}
