//! Datasets on disk, in one test binary.

mod damage;
mod foreign;
mod interruption;
mod lance;
mod loader;
mod sample;
