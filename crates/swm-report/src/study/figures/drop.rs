//! The gap of each condition: a dot with its interval for each policy.

use super::{AXIS, Drawn, finish, legend};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, TEXT, stroke, units};
use crate::study::sheet::{Policy, Sheet};
use crate::study::told_apart;
use crate::text::{escape, points, shorten, whole_points};
use plotters::element::ErrorBar;
use plotters::style::Color as _;
use swm_core::Result;
use swm_core::results::Paired;

/// The largest number of dots.
pub(super) const MOST: usize = 120;
/// The height of a dot's row.
const ROW: f64 = 19.0;
/// The height of the name of a condition above its dots.
const NAME: f64 = 21.0;
/// The space below a condition.
const SPACE: f64 = 9.0;
/// The width of the names beside the dots.
const NAMES: f64 = 190.0;
/// The width of the values beside the dots.
const VALUES: f64 = 138.0;

/// The dots of one condition.
struct Condition<'a> {
    name: String,
    dots: Vec<(Policy<'a>, Paired)>,
}

struct Gaps<'a> {
    conditions: Vec<Condition<'a>>,
    unshifted: String,
}

/// Draws the gaps of these conditions; nothing if no condition has one.
pub(super) fn draw(sheet: &Sheet<'_>, counting: usize, conditions: &[usize]) -> Result<Vec<Drawn>> {
    let dots = |condition: usize| {
        let policies = sheet.policies.iter().enumerate();
        let gap = |policy| sheet.row(condition, policy, counting)?.gap.filter(is_drawable);
        policies.filter_map(|(i, policy)| Some((*policy, gap(i)?))).collect::<Vec<_>>()
    };
    let conditions = conditions
        .iter()
        .map(|condition| Condition { name: shorten(sheet.conditions[*condition], 200), dots: dots(*condition) });
    let conditions: Vec<_> = conditions.filter(|condition| !condition.dots.is_empty()).collect();
    if conditions.is_empty() {
        return Ok(vec![]);
    }
    let unshifted = sheet.unshifted.map_or(String::new(), |condition| shorten(sheet.conditions[condition], 60));
    let caption = format!(
        "The success rate under a condition minus that under “{}”, for the same policy on the same starts, with its interval; \
         the intervals of a family hold together with 95 %. A filled dot is told apart from zero; a ring is not.",
        escape(&unshifted)
    );
    finish("drop", "Gap of each condition".to_owned(), caption, &Gaps { conditions, unshifted })
}

/// Whether a gap is a difference of rates with an interval.
fn is_drawable(gap: &Paired) -> bool {
    [gap.low, gap.difference, gap.high].iter().all(|value| (-1.0..=1.0).contains(value)) && gap.low <= gap.high
}

impl Gaps<'_> {
    /// The height of a condition, and how far below its top its dots begin.
    fn block(&self, condition: &Condition<'_>, layout: Layout) -> [f64; 2] {
        let dots = condition.dots.len() as f64 * ROW;
        match layout {
            Layout::Wide => [dots + SPACE, 0.0],
            Layout::Narrow => [NAME + dots + SPACE, NAME],
        }
    }

    /// The policies that have dots.
    fn legend(&self) -> Vec<(Ink, String)> {
        let mut entries: Vec<(Ink, String)> = vec![];
        for (policy, _) in self.conditions.iter().flat_map(|condition| &condition.dots) {
            if !entries.iter().any(|(_, name)| name == policy.name) {
                entries.push((policy.ink, policy.name.to_owned()));
            }
        }
        entries
    }

    /// The ends of the axis, in percentage points.
    fn range(&self) -> [f64; 2] {
        let ends =
            || self.conditions.iter().flat_map(|c| &c.dots).flat_map(|(_, gap)| [100.0 * gap.low, 100.0 * gap.high]);
        [ends().fold(0.0, f64::min) - 2.0, ends().fold(0.0, f64::max) + 2.0]
    }
}

impl Figure for Gaps<'_> {
    fn height(&self, layout: Layout) -> f64 {
        legend::height(self.legend().len(), layout)
            + self.conditions.iter().map(|condition| self.block(condition, layout)[0]).sum::<f64>()
            + AXIS
            + 6.0
    }

    fn description(&self) -> String {
        let sentences = self.conditions.iter().flat_map(|condition| {
            let sentence = |(policy, gap): &(Policy<'_>, Paired)| {
                let [gap, low, high] = [gap.difference, gap.low, gap.high].map(points);
                format!("{}, {}: {gap} points, {low} to {high}", condition.name, policy.name)
            };
            condition.dots.iter().map(sentence)
        });
        format!("Gaps to {}: {}", self.unshifted, sentences.collect::<Vec<_>>().join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let (layout, width) = (canvas.layout, canvas.width());
        let entries = self.legend();
        legend::draw(canvas, &entries)?;
        let above = legend::height(entries.len(), layout);
        let left = if layout == Layout::Wide { NAMES } else { 14.0 };
        let (right, bottom) = (width - VALUES, self.height(layout) - AXIS);
        let [low, high] = self.range();
        let ticks = |value: &f64| if *value == 0.0 { "0".to_owned() } else { whole_points(value / 100.0) };
        let area = [left, above + 4.0, right, bottom];
        let mut chart = canvas.chart(area, (low..high, &ticks), (bottom..above + 4.0, None))?;
        let x = |share: f64| left + (100.0 * share - low) / (high - low) * (right - left);
        canvas.line(&[[x(0.0), above + 4.0], [x(0.0), bottom]], stroke(Ink::Soft, 1.25))?;
        let title = "gap, percentage points";
        canvas.text([f64::midpoint(left, right), bottom + 36.0], Anchor::Middle, SMALL, Ink::Soft, title)?;
        let mut top = above + 6.0;
        for condition in &self.conditions {
            let [height, offset] = self.block(condition, layout);
            let (start, end, room) = match layout {
                Layout::Wide => ([left - 12.0, top + (height - SPACE) / 2.0], Anchor::End, left - 14.0),
                Layout::Narrow => ([0.0, top + NAME / 2.0], Anchor::Start, width - 4.0),
            };
            let name = canvas.fit(TEXT, &condition.name, room);
            if layout == Layout::Narrow {
                // The name covers the lines of the grid.
                let size = [canvas.measure(TEXT, &name) + 3.0, NAME - 3.0];
                canvas.rect([0.0, top + 1.5], size, Ink::Surface.rgb().filled())?;
            }
            canvas.text(start, end, TEXT, Ink::Text, &name)?;
            for (i, (policy, gap)) in condition.dots.iter().enumerate() {
                let y = top + offset + (i as f64 + 0.5) * ROW;
                let [low, middle, high] = [gap.low, gap.difference, gap.high].map(|share| 100.0 * share);
                let bar =
                    ErrorBar::new_horizontal(y, low, middle, high, stroke(policy.ink, 2.0), units(8.0).unsigned_abs());
                chart.draw_series([bar])?;
                canvas.dot([x(gap.difference), y], 5.0, policy.ink, told_apart(gap))?;
                let ends = [gap.low, gap.high].map(whole_points);
                let value = format!("{} [{}, {}]", points(gap.difference), ends[0], ends[1]);
                canvas.text([right + 14.0, y], Anchor::Start, SMALL + 0.5, Ink::Text, &value)?;
            }
            top += height;
        }
        Ok(())
    }
}
