//! Studies: many evaluations of one question, with one result.
//!
//! A [`Study`] is a list of [`Cell`]s, each an [`EvalRequest`](crate::EvalRequest) with the hashes of its inputs. [`Study::run`]
//! evaluates the cells whose results are not in the [`StudyFolder`] yet. All cells with one source of starts and one seed play
//! the same starts, so that policies and conditions are compared in pairs.
//!
//! With a rule that ends it ([`Study::until`]), a study plays its starts in stages, and the results of a stage decide which
//! cells play more.
//!
//! A [`TableStudy`] has cells that are no evaluations, such as the factors of every environment, in the same folder.
//!
//! The files of a study of evaluations hold no times, so a study that was interrupted and continued writes the same bytes as one that was
//! not.

mod cell;
mod folder;
mod image_distance;
mod registration;
mod rows;
mod run;
mod stages;
mod table;

pub use cell::{Cell, Common, Study};
pub use folder::StudyFolder;
pub use table::{AnyStudy, Measured, TableCell, TableStudy};
