//! What holds of every scene, however odd, and what simple scenes look like.

mod moving;
mod odd;
mod plain;
mod scenes;
