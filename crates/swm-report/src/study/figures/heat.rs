//! Success rates of conditions by policies, as a map of colours.

use super::{Drawn, drop, finish, scale};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface};
use crate::study::sheet::Sheet;
use crate::text::shorten;
use plotters::style::Color as _;
use swm_core::Result;

/// The largest numbers of conditions and of policies.
const MOST: [usize; 2] = [60, 24];
/// The height of a condition.
const ROW: f64 = 20.0;
/// The height of the name of a condition above its cells.
const NAME: f64 = 19.0;
/// The height of the numbers of the policies.
const HEAD: f64 = 26.0;
/// The height of the name of a policy below the map.
const KEY: f64 = 18.0;
/// The widest cell.
const WIDEST: f64 = 96.0;
/// The narrowest cell with its value.
const VALUE: f64 = 26.0;

struct Map {
    conditions: Vec<String>,
    policies: Vec<String>,
    /// The rates, by condition and policy.
    rates: Vec<Vec<Option<f64>>>,
}

/// Whether the conditions have more dots than the figure of gaps shows, or no gaps.
pub(super) fn is_better(sheet: &Sheet<'_>, conditions: &[usize]) -> bool {
    conditions.len().saturating_mul(sheet.policies.len()) > drop::MOST || sheet.unshifted.is_none()
}

/// Draws the success rates of the condition that is not shifted, and of these.
pub(super) fn draw(sheet: &Sheet<'_>, counting: usize, conditions: &[usize]) -> Result<Vec<Drawn>> {
    let all: Vec<usize> = sheet.unshifted.into_iter().chain(conditions.iter().copied()).collect();
    let shown = &all[..all.len().min(MOST[0])];
    let policies = sheet.policies.len().min(MOST[1]);
    let rate = |condition: usize, policy: usize| {
        let rate = sheet.row(condition, policy, counting)?.success.rate;
        (0.0..=1.0).contains(&rate).then_some(rate)
    };
    let map = Map {
        conditions: shown.iter().map(|condition| shorten(sheet.conditions[*condition], 200)).collect(),
        policies: sheet.policies[..policies].iter().map(|policy| shorten(policy.name, 200)).collect(),
        rates: shown.iter().map(|condition| (0..policies).map(|policy| rate(*condition, policy)).collect()).collect(),
    };
    let mut caption = "The success rate of every policy under every condition, in percent.".to_owned();
    for (what, shown, all) in [("conditions", shown.len(), all.len()), ("policies", policies, sheet.policies.len())] {
        if shown < all {
            caption += &format!(" The first {shown} of {all} {what} are drawn; the table has the others.");
        }
    }
    finish("heat", "Success of every policy under every condition".to_owned(), caption, &map)
}

impl Map {
    /// The left edge of the cells and their width.
    fn columns(&self, layout: Layout) -> [f64; 2] {
        let left = if layout == Layout::Wide { 260.0 } else { 0.0 };
        [left, ((layout.width() - left) / self.policies.len().max(1) as f64).min(WIDEST)]
    }

    fn row(layout: Layout) -> f64 {
        if layout == Layout::Wide { ROW } else { NAME + ROW }
    }

    fn bottom(&self, layout: Layout) -> f64 {
        HEAD + self.conditions.len() as f64 * Self::row(layout)
    }
}

impl Figure for Map {
    fn height(&self, layout: Layout) -> f64 {
        self.bottom(layout) + 12.0 + self.policies.len() as f64 * KEY + 10.0 + scale::HEIGHT
    }

    fn description(&self) -> String {
        let row = |(condition, rates): (&String, &Vec<Option<f64>>)| {
            let rates = rates.iter().map(|rate| rate.map_or("–".to_owned(), |rate| format!("{:.0}", 100.0 * rate)));
            format!("{condition}: {}", rates.collect::<Vec<_>>().join(", "))
        };
        let rows: Vec<String> = self.conditions.iter().zip(&self.rates).map(row).collect();
        format!("Success rates in percent of {}. {}", self.policies.join(", "), rows.join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let [left, width] = self.columns(canvas.layout);
        for policy in 0..self.policies.len() {
            let x = left + (policy as f64 + 0.5) * width;
            canvas.text([x, HEAD / 2.0], Anchor::Middle, SMALL, Ink::Soft, &(policy + 1).to_string())?;
        }
        for (i, (name, rates)) in self.conditions.iter().zip(&self.rates).enumerate() {
            let top = HEAD + i as f64 * Self::row(canvas.layout);
            let cells = if canvas.layout == Layout::Wide {
                let name = canvas.fit(SMALL + 0.5, name, left - 16.0);
                canvas.text([left - 12.0, top + ROW / 2.0], Anchor::End, SMALL + 0.5, Ink::Text, &name)?;
                top
            } else {
                let name = canvas.fit(SMALL + 0.5, name, canvas.width() - 4.0);
                canvas.text([0.0, top + NAME / 2.0], Anchor::Start, SMALL + 0.5, Ink::Text, &name)?;
                top + NAME
            };
            for (policy, rate) in rates.iter().enumerate() {
                let Some(rate) = rate else { continue };
                let corner = [left + policy as f64 * width + 1.0, cells + 1.0];
                let fill = scale::colour(*rate);
                canvas.rect(corner, [width - 2.0, ROW - 2.0], fill.filled())?;
                if width >= VALUE {
                    let at = [corner[0] + width / 2.0 - 1.0, cells + ROW / 2.0];
                    let value = format!("{:.0}", 100.0 * rate);
                    canvas.text(at, Anchor::Middle, SMALL, Ink::on(fill), &value)?;
                }
            }
        }
        let mut top = self.bottom(canvas.layout) + 12.0;
        for (i, policy) in self.policies.iter().enumerate() {
            let words = canvas.fit(SMALL + 0.5, &format!("{}  {policy}", i + 1), canvas.width() - left - 4.0);
            canvas.text([left, top + KEY / 2.0], Anchor::Start, SMALL + 0.5, Ink::Text, &words)?;
            top += KEY;
        }
        scale::legend(canvas, [left, top + 10.0], 240.0)
    }
}
