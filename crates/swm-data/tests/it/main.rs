//! Datasets on disk, in one test binary.

mod lance;
