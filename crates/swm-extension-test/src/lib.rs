//! Tests of extensions by third-party crates: `tests/it` adds an environment, a dataset format, a solver and a model
//! family with only the public API of the facade `swm`, and runs these extensions together.
