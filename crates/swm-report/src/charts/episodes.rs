//! The chart of all episodes.

use super::svg::{LABELS, NAME, Svg, WIDE};
use crate::group::Group;
use crate::text::{outcome, shorten};

/// Draws every episode as a square, in order, so that runs on the same starts can be compared start by start.
pub(crate) fn chart(group: &Group<'_>) -> String {
    const CELL: f64 = 12.0;
    const COLUMNS: usize = 60;
    let lines = |n: usize| n.div_ceil(COLUMNS).max(1);
    let height: f64 = group.conditions.iter().map(|_| 34.0).sum::<f64>()
        + group.rows().map(|row| lines(row.run.episodes.len()) as f64 * CELL + 11.0).sum::<f64>();
    let mut svg = Svg::new(WIDE, height + 4.0);
    let mut top = 0.0;
    for condition in &group.conditions {
        svg.text("head", [0.0, top + 20.0], &shorten(condition.name, 60));
        top += 34.0;
        for row in &condition.rows {
            svg.text("label end", [LABELS - 14.0, top + 9.5], &shorten(&row.label, NAME));
            for (i, episode) in row.run.episodes.iter().enumerate() {
                let corner = [LABELS + (i % COLUMNS) as f64 * CELL, top + (i / COLUMNS) as f64 * CELL];
                let (class, outcome) = outcome(episode);
                let class = format!("cell {class} {}", row.class);
                let tip = format!("episode {i}, seed {}: {outcome}", episode.seed);
                svg.rect(&class, corner, [CELL - 2.0, CELL - 2.0], &tip);
            }
            let used = lines(row.run.episodes.len()) as f64 * CELL;
            top += used + 11.0;
        }
    }
    svg.finish("Every episode as a square: filled if solved, empty if not solved")
}
