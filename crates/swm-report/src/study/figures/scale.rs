//! The colours of heat maps: a scale of success rates and its legend.

use crate::plot::{Anchor, Canvas, Drawn as Painted, Ink, SMALL, Surface};
use plotters::style::colors::colormaps::ViridisRGB;
use plotters::style::{Color as _, RGBColor};

/// The colour of a rate: viridis, which is ordered in lightness and legible to the colour-blind.
pub(super) fn colour(rate: f64) -> RGBColor {
    ViridisRGB::get_color(if rate.is_finite() { rate.clamp(0.0, 1.0) } else { 0.0 })
}

/// The height of the legend.
pub(super) const HEIGHT: f64 = 48.0;

/// Draws the legend with its top left corner at `[left, top]`.
pub(super) fn legend<B: Surface>(canvas: &Canvas<B>, [left, top]: [f64; 2], width: f64) -> Painted<B> {
    const PARTS: usize = 50;
    canvas.text([left, top + 6.0], Anchor::Start, SMALL, Ink::Soft, "success rate")?;
    let part = width / PARTS as f64;
    for i in 0..PARTS {
        let fill = colour((i as f64 + 0.5) / PARTS as f64).filled();
        // Parts overlap, so that no line of the background shows between them.
        let overlap = if i + 1 == PARTS { 0.0 } else { 0.5 };
        canvas.rect([left + i as f64 * part, top + 15.0], [part + overlap, 12.0], fill)?;
    }
    for (share, anchor) in [(0.0, Anchor::Start), (0.5, Anchor::Middle), (1.0, Anchor::End)] {
        let words = format!("{:.0}\u{a0}%", 100.0 * share);
        canvas.text([left + share * width, top + 36.0], anchor, SMALL, Ink::Soft, &words)?;
    }
    Ok(())
}
