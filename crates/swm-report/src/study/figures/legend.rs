//! The legend of policies.

use crate::plot::{Anchor, Canvas, Drawn as Painted, Ink, Layout, SMALL, Surface};

/// The height of an entry.
const ENTRY: f64 = 19.0;
/// The space around the legend.
const SPACE: f64 = 12.0;

/// Returns the number of entries in a line.
fn columns(layout: Layout) -> usize {
    if layout == Layout::Wide { 2 } else { 1 }
}

/// The height of a legend.
pub(super) fn height(entries: usize, layout: Layout) -> f64 {
    if entries == 0 { 0.0 } else { entries.div_ceil(columns(layout)) as f64 * ENTRY + SPACE }
}

/// Draws a legend at the top of the canvas.
pub(super) fn draw<B: Surface>(canvas: &Canvas<B>, entries: &[(Ink, String)]) -> Painted<B> {
    let width = canvas.width() / columns(canvas.layout) as f64;
    for (i, (ink, words)) in entries.iter().enumerate() {
        let (row, column) = (i / columns(canvas.layout), i % columns(canvas.layout));
        let [x, y] = [column as f64 * width, (row as f64 + 0.5) * ENTRY + 2.0];
        canvas.dot([x + 7.0, y], 5.0, *ink, true)?;
        let words = canvas.fit(SMALL + 0.5, words, width - 30.0);
        canvas.text([x + 19.0, y], Anchor::Start, SMALL + 0.5, Ink::Text, &words)?;
    }
    Ok(())
}
