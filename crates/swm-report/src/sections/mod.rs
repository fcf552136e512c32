//! The sections of the page, one file each.

mod cards;
pub(crate) mod group;
pub(crate) mod provenance;
mod runs_table;
pub(crate) mod training;
mod videos;

use std::fmt::Write as _;

/// Writes a figure with a heading and a caption.
fn figure(html: &mut String, heading: &str, caption: &str, content: &str) {
    let _ = write!(
        html,
        "<figure class=\"plot\">\n<h3>{heading}</h3>\n<div class=\"wide\">\n{content}</div>\n\
         <figcaption>{caption}</figcaption>\n</figure>\n"
    );
}
