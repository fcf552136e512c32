//! Worlds of a tiny environment, so that what is tested is the world and nothing else.

mod collecting;
mod counting;
mod evaluating;
mod lance;
mod line;
mod memory;
mod predicting;
mod replaying;
mod requesting;
