//! Densities of the prediction errors of solved and of failed trajectories, a panel for each source of starts and condition.

use super::{Drawn, finish, legend};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, TEXT, stroke};
use crate::text::{escape, number, shorten};
use plotters::style::Color as _;
use swm_core::Result;
use swm_core::results::{Density, ErrorAndSuccess, StudyResults, StudyRow};

/// The largest number of panels of a figure.
const MOST: usize = 12;
/// The height of a panel: its two lines of text, its curves, and its ticks.
const PANEL: f64 = 214.0;
/// The height of the lines of text above the curves.
const HEAD: f64 = 44.0;
/// The height of the ticks and of the space below a panel.
const FOOT: f64 = 50.0;
/// The number of points of a curve.
const POINTS: usize = 120;
/// The colours of solved and of failed trajectories.
const INKS: [Ink; 2] = [Ink::Policy(0), Ink::Policy(1)];

struct Densities {
    panels: Vec<Panel>,
    /// The logarithms of the errors at the ends of all panels.
    range: [f64; 2],
}

struct Panel {
    name: String,
    /// The AUC and the overlap, or why there are none.
    words: String,
    /// The densities of solved and of failed trajectories, and their numbers.
    densities: [(Option<Density>, usize); 2],
}

/// Draws a figure for each policy with prediction errors, from the rows with the first counting.
pub(in crate::study) fn draw(results: &StudyResults) -> Result<Vec<Drawn>> {
    let rows = || results.rows.iter().filter_map(|row| Some((row, row.prediction.as_ref()?)));
    let Some((first, _)) = rows().next() else { return Ok(vec![]) };
    let rows = || rows().filter(|(row, _)| row.counting == first.counting && row.seed == first.seed);
    let mut policies: Vec<&str> = vec![];
    for (row, _) in rows() {
        if !policies.contains(&row.policy.as_str()) {
            policies.push(&row.policy);
        }
    }
    let several = rows().any(|(row, _)| row.condition != first.condition);
    let mut drawn = vec![];
    for policy in policies {
        let of = rows().filter(|(row, _)| row.policy == policy).take(MOST);
        let panels: Vec<Panel> = of.map(|(row, errors)| Panel::of(row, errors, several)).collect();
        let ranges = || {
            panels.iter().flat_map(|panel| &panel.densities).filter_map(|(density, _)| Some(density.as_ref()?.range()))
        };
        let range = ranges().reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
        let Some(range) = range.filter(|[low, high]| low < high && (high - low) < 40.0) else { continue };
        let caption = "Densities of the mean prediction error of a trajectory, on a logarithmic axis; an error of 1 is that of \
                       predicting the mean latent. The AUC is the probability that a failed trajectory has a larger error than a \
                       solved one; the overlap is the area that both densities share.";
        let heading = format!("Prediction errors of {}", escape(&shorten(policy, 60)));
        drawn.extend(finish("prediction", heading, caption.to_owned(), &Densities { panels, range })?);
    }
    Ok(drawn)
}

impl Panel {
    fn of(row: &StudyRow, errors: &ErrorAndSuccess, with_condition: bool) -> Self {
        let condition = if with_condition { format!(", {}", row.condition) } else { String::new() };
        let words = match errors.discrimination {
            None => "solved and failed are not both there".to_owned(),
            Some(found) => {
                let overlap = found.overlap.map_or(String::new(), |overlap| format!(" · overlap {overlap:.2}"));
                format!("AUC {:.2} [{:.2}, {:.2}]{overlap}", found.auc, found.low, found.high)
            }
        };
        let densities = [&errors.solved, &errors.failed].map(|errors| (Density::of(errors), errors.len()));
        Self { name: shorten(&format!("{}{condition}", row.starts), 120), words, densities }
    }
}

impl Densities {
    fn columns(&self, layout: Layout) -> usize {
        if layout == Layout::Wide { self.panels.len().clamp(1, 4) } else { 1 }
    }

    fn legend() -> Vec<(Ink, String)> {
        vec![(INKS[0], "solved".to_owned()), (INKS[1], "failed".to_owned())]
    }
}

impl Figure for Densities {
    fn height(&self, layout: Layout) -> f64 {
        let rows = self.panels.len().div_ceil(self.columns(layout)) as f64;
        legend::height(2, layout) + rows * PANEL
    }

    fn description(&self) -> String {
        let panel = |panel: &Panel| {
            let [(_, solved), (_, failed)] = &panel.densities;
            format!("{}: {solved} solved, {failed} failed, {}", panel.name, panel.words)
        };
        format!("Densities of prediction errors. {}", self.panels.iter().map(panel).collect::<Vec<_>>().join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        legend::draw(canvas, &Self::legend())?;
        let columns = self.columns(canvas.layout);
        let width = canvas.width() / columns as f64;
        let above = legend::height(2, canvas.layout);
        let [low, high] = self.range;
        for (i, panel) in self.panels.iter().enumerate() {
            let (left, top) = ((i % columns) as f64 * width + 8.0, above + (i / columns) as f64 * PANEL);
            let (right, bottom) = (left + width - 22.0, top + PANEL - FOOT);
            let fit = |size, words: &str| canvas.fit(size, words, right - left);
            canvas.text([left, top + 10.0], Anchor::Start, TEXT, Ink::Text, &fit(TEXT, &panel.name))?;
            canvas.text([left, top + 28.0], Anchor::Start, SMALL, Ink::Soft, &fit(SMALL, &panel.words))?;
            let x = |at: f64| left + (at - low) / (high - low) * (right - left);
            canvas.line(&[[left, bottom], [right, bottom]], stroke(Ink::Soft, 1.0))?;
            for tick in ticks(low, high) {
                let words = number(10f64.powf(tick));
                // A tick at an end would leave the panel.
                let half = canvas.measure(SMALL, &words) / 2.0;
                canvas.line(&[[x(tick), top + HEAD], [x(tick), bottom + 4.0]], stroke(Ink::Grid, 1.0))?;
                if x(tick) - half >= left - 6.0 && x(tick) + half <= right + 6.0 {
                    canvas.text([x(tick), bottom + 14.0], Anchor::Middle, SMALL, Ink::Soft, &words)?;
                }
            }
            let middle = f64::midpoint(left, right);
            canvas.text([middle, bottom + 31.0], Anchor::Middle, SMALL, Ink::Soft, "prediction error")?;
            let at = |i: usize| low + (high - low) * i as f64 / (POINTS - 1) as f64;
            let curve = |density: &Density| (0..POINTS).map(|i| density.at(at(i))).collect::<Vec<f64>>();
            let curves = panel.densities.each_ref().map(|(density, _)| density.as_ref().map(curve));
            let highest = curves.iter().flatten().flatten().fold(1e-9_f64, |highest, value| highest.max(*value));
            for (curve, ink) in curves.iter().zip(INKS) {
                let Some(curve) = curve else { continue };
                let y = |value: &f64| bottom - value / highest * (bottom - top - HEAD);
                let points: Vec<[f64; 2]> = curve.iter().enumerate().map(|(i, value)| [x(at(i)), y(value)]).collect();
                let ends = [[right, bottom], [left, bottom]];
                canvas.polygon(&[&points[..], &ends].concat(), ink.rgb().mix(0.2).filled())?;
                canvas.line(&points, stroke(ink, 2.0))?;
            }
        }
        Ok(())
    }
}

/// Powers of ten within the range, with their halves where it is short; at most six.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let step = [0.5, 1.0, 2.0, 5.0].into_iter().find(|step| (high - low) / step <= 5.0).unwrap_or(10.0);
    let first = (low / step).ceil() as i32;
    (first..).map(|i| f64::from(i) * step).take_while(|tick| *tick <= high).collect()
}
