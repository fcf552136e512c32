//! The `swm` command.

mod allocator;

#[global_allocator]
static ALLOCATOR: allocator::Allocator = allocator::Allocator;

fn main() -> std::process::ExitCode {
    swm::cli::run(std::env::args_os()).into()
}
