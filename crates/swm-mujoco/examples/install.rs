//! Installs every asset that is not installed, as `swm assets install` does.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use swm_mujoco::assets::{self, Status};

fn main() -> swm_core::Result<()> {
    for (asset, status) in assets::status() {
        if status == Status::Absent {
            println!("{}", assets::install(asset.name)?.display());
        }
        assets::verify(asset.name)?;
    }
    swm_mujoco::link::load()
}
