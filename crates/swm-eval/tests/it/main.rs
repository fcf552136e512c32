//! Tests of `World`, mostly with a minimal environment on a line.

mod collecting;
mod counting;
mod evaluating;
mod interrupting;
mod lance;
mod line;
mod memory;
mod nearest;
mod one_start;
mod predicting;
mod replaying;
mod requesting;
mod stopping;
