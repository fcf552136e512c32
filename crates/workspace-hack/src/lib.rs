//! An empty crate. Its manifest names features of shared dependencies; crates that reach Lance or Burn depend on it, so
//! that the program, the Python extension and the tests compile each library once.
//!
//! `cargo xtask features` compares what Cargo resolves for each of these builds.
