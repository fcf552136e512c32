//! Tests of datasets on disk, in one test binary.

// Skipped tests print the reason, and child processes print results, to standard output.
#![allow(clippy::print_stdout, reason = "reports of skipped tests and of child processes")]

mod cache;
mod commit_race;
mod convert;
mod damage;
mod doctor;
#[cfg(feature = "s3")]
mod faults;
mod folder;
mod forged_hash;
mod format_suite;
mod full_disk;
mod fuzz;
mod goals;
#[cfg(feature = "hdf5")]
mod hdf5;
#[cfg(feature = "hdf5")]
mod hdf5_links;
#[cfg(all(feature = "hdf5", feature = "s3", feature = "http"))]
mod hdf5_objects;
mod hostile;
mod interruption;
mod kill;
mod killed_early;
mod lance;
mod lance_shards;
mod lance_video;
mod lerobot;
mod lerobot_ranges;
mod loader;
mod objects;
mod overwriting;
mod parquet_codecs;
mod preview;
mod reference;
mod replaced_while_read;
mod replacing;
mod replay;
mod sample;
mod second_writer;
mod video;
mod views;
