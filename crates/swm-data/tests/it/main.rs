//! Datasets on disk, in one test binary.

// Tests say on standard output why they are skipped; the child process of one of them reports there.
#![allow(clippy::print_stdout)]

mod cache;
mod convert;
mod damage;
mod doctor;
mod folder;
mod foreign;
mod format_suite;
mod fuzz;
mod goals;
#[cfg(feature = "hdf5")]
mod hdf5;
#[cfg(all(feature = "hdf5", feature = "s3", feature = "http"))]
mod hdf5_objects;
mod interruption;
mod kill;
mod lance;
mod lance_shards;
mod lance_video;
mod lerobot;
mod loader;
mod objects;
mod preview;
mod replay;
mod sample;
mod video;
mod views;
