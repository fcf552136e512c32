//! Extensions outside the workspace's own crates: `tests/it` adds an environment, a dataset format, a solver and a model
//! family with the public API of the facade `swm` only, and runs them together.
