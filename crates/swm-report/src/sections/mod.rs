//! The sections of the page, one file each.

mod cards;
pub(crate) mod group;
pub(crate) mod provenance;
mod runs_table;
pub(crate) mod training;
pub(crate) mod videos;

use crate::limits::{self, mebibytes};
use std::fmt::Write as _;

/// Writes a figure with a heading and a caption; a sentence replaces its content if the page is too large already.
fn figure(html: &mut String, heading: &str, caption: &str, content: &str) {
    let left_out = format!("<p>Left out, because the page has {} already.</p>\n", mebibytes(html.len() as u64));
    let content = if html.len() + content.len() > limits::PAGE_BYTES { &left_out } else { content };
    let _ = write!(
        html,
        "<figure class=\"plot\">\n<h3>{heading}</h3>\n<div class=\"wide\">\n{content}</div>\n\
         <figcaption>{caption}</figcaption>\n</figure>\n"
    );
}
