//! Success against a variable with numbers, with intervals and a fitted decay.

use super::{AXIS, Drawn, finish, legend};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, stroke, units};
use crate::study::decay::{Decay, Point};
use crate::study::sheet::{Policy, Sheet};
use crate::text::{escape, number, percent, shorten};
use plotters::element::{DashedPathElement, ErrorBar};
use plotters::series::LineSeries;
use swm_core::Result;
use swm_core::results::Proportion;

/// The largest number of policies.
const POLICIES: usize = 12;
/// The largest number of values of the variable.
const VALUES: usize = 200;
/// The height of the chart.
const CHART: f64 = 300.0;
/// The number of lines that a fitted curve consists of.
const CURVE: u32 = 100;
/// The distance between the dots of two policies at one value, in pixels.
const APART: f64 = 5.0;

/// The rates of one policy.
struct Series<'a> {
    policy: Policy<'a>,
    points: Vec<(f64, Proportion)>,
    /// The rate of the condition that is not shifted, if it has no value of the variable.
    unshifted: Option<f64>,
    decay: Option<Decay>,
}

struct Lines<'a> {
    variable: String,
    series: Vec<Series<'a>>,
    /// The rates of the random-policy floor.
    floor: Vec<(f64, f64)>,
    /// Whether a decay was fitted: its interval is that of a fixed number of episodes.
    is_fitted: bool,
}

/// Draws the success rates over a variable; `values` are its values and the conditions.
pub(super) fn draw(sheet: &Sheet<'_>, counting: usize, variable: &str, values: &[(f64, usize)]) -> Result<Vec<Drawn>> {
    let value = |condition: usize| super::number(sheet.variables(condition)?.get(variable)?);
    let at_unshifted = sheet.unshifted.and_then(|condition| Some((value(condition)?, condition)));
    let mut all: Vec<(f64, usize)> = at_unshifted.into_iter().chain(values.iter().copied()).take(VALUES).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let series = sheet.policies.iter().enumerate().take(POLICIES).map(|(i, policy)| {
        let rate = |condition: usize| Some(sheet.row(condition, i, counting)?.success).filter(is_drawable);
        let points: Vec<_> = all.iter().filter_map(|(x, condition)| Some((*x, rate(*condition)?))).collect();
        let counts = points.iter().map(|(x, p)| Point { x: *x, successes: p.successes as f64, n: p.n as f64 });
        let decay = Decay::fit(&counts.collect::<Vec<_>>()).filter(|decay| decay.low > 0.0 && !sheet.sequential);
        let unshifted = if at_unshifted.is_none() { sheet.unshifted.and_then(rate).map(|p| p.rate) } else { None };
        Series { policy: *policy, points, unshifted, decay }
    });
    let series: Vec<Series<'_>> = series.filter(|series| series.points.len() > 1).collect();
    if series.is_empty() {
        return Ok(vec![]);
    }
    let shows_floor = !series.iter().any(|series| series.policy.ink == Ink::Floor);
    let floor = |condition: usize| sheet.rows_of(condition).find(|([_, of], _)| *of == counting).map(|(_, row)| row);
    let floor = all.iter().filter(|_| shows_floor).filter_map(|(x, condition)| Some((*x, floor(*condition)?.floor)));
    let floor = floor.filter(|(_, floor)| is_drawable(floor)).map(|(x, floor)| (x, floor.rate)).collect();
    let lines = Lines { variable: shorten(variable, 60), series, floor, is_fitted: !sheet.sequential };
    let heading = format!("Success against {}", escape(&lines.variable));
    finish("line", heading, lines.caption(), &lines)
}

/// Whether a rate is a share with an interval.
fn is_drawable(p: &Proportion) -> bool {
    [p.low, p.rate, p.high].iter().all(|share| (0.0..=1.0).contains(share)) && p.low <= p.rate && p.rate <= p.high
}

impl Series<'_> {
    /// The largest distance between a rate and the fitted curve.
    fn deviation(&self, decay: &Decay) -> f64 {
        self.points.iter().map(|(x, p)| (p.rate - decay.at(*x)).abs()).fold(0.0, f64::max)
    }
}

impl Lines<'_> {
    /// The ends of the horizontal axis.
    fn range(&self) -> [f64; 2] {
        let x = || self.series.iter().flat_map(|series| &series.points).map(|(x, _)| *x);
        let (low, high) = (x().fold(f64::INFINITY, f64::min), x().fold(f64::NEG_INFINITY, f64::max));
        // Ticks need differences that the numbers can express.
        let room = ((high - low) * 0.03).max(low.abs().max(high.abs()) * 1e-6).max(1e-9);
        [low - room, high + room]
    }

    fn legend(&self) -> Vec<(Ink, String)> {
        let entry = |series: &Series<'_>| {
            let name = series.policy.name;
            let words = series.decay.map_or(name.to_owned(), |decay| {
                let [rate, low, high] = [decay.rate, decay.low, decay.high].map(|rate| format!("{rate:.3}"));
                format!("{}: rate {rate} [{low}, {high}]", shorten(name, 24))
            });
            (series.policy.ink, words)
        };
        let floor = (!self.floor.is_empty()).then(|| (Ink::Floor, "random-policy floor".to_owned()));
        self.series.iter().map(entry).chain(floor).collect()
    }

    fn caption(&self) -> String {
        let mut caption = "Success rates with their 95 % intervals.".to_owned();
        if self.series.iter().any(|series| series.unshifted.is_some()) {
            caption += " Dashed lines are the rates of the condition that is not shifted.";
        }
        if !self.is_fitted {
            return caption;
        }
        let fitted: Vec<_> = self.series.iter().filter_map(|series| Some((series, series.decay?))).collect();
        if fitted.is_empty() {
            return caption + " No exponential decay is told apart from a constant rate.";
        }
        caption += &format!(
            " Curves are exponential decays a·exp(−b·{}) of greatest likelihood. The interval of a rate b is that of its \
             profile likelihood; it takes the counts as independent, although they share their starts.",
            escape(&self.variable)
        );
        for (series, decay) in fitted {
            let [rate, low, high] = [decay.rate, decay.low, decay.high].map(|rate| format!("{rate:.3}"));
            caption += &format!(
                " {}: b = {rate} [{low}, {high}], half of the success is lost every {}; the rates are at most {} points \
                 from the curve.",
                escape(&shorten(series.policy.name, 60)),
                number((20.0 * std::f64::consts::LN_2 / decay.rate).round() / 20.0),
                number((1000.0 * series.deviation(&decay)).round() / 10.0)
            );
        }
        caption
    }
}

impl Figure for Lines<'_> {
    fn height(&self, layout: Layout) -> f64 {
        legend::height(self.legend().len(), layout) + CHART + AXIS
    }

    fn description(&self) -> String {
        let series = self.series.iter().map(|series| {
            let rates = series.points.iter().map(|(x, p)| format!("{} at {}", percent(p.rate), number(*x)));
            format!("{}: {}", series.policy.name, rates.collect::<Vec<_>>().join(", "))
        });
        format!("Success against {}. {}", self.variable, series.collect::<Vec<_>>().join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let entries = self.legend();
        legend::draw(canvas, &entries)?;
        let top = legend::height(entries.len(), canvas.layout) + 4.0;
        let (left, right, bottom) = (46.0, canvas.width() - 12.0, top + CHART - 8.0);
        let [low, high] = self.range();
        let shares = |share: &f64| format!("{:.0}\u{a0}%", 100.0 * share);
        let area = [left, top, right, bottom];
        let mut chart = canvas.chart(area, (low..high, &|x| number(*x)), (0.0..1.0, Some(&shares)))?;
        let title = canvas.fit(SMALL, &self.variable, right - left);
        canvas.text([f64::midpoint(left, right), bottom + 34.0], Anchor::Middle, SMALL, Ink::Soft, &title)?;
        let dashes =
            |points: Vec<(f64, f64)>, ink| DashedPathElement::new(points, units(5.0), units(4.0), stroke(ink, 1.5));
        if !self.floor.is_empty() {
            chart.draw_series([dashes(self.floor.clone(), Ink::Floor)])?;
        }
        let to_value = (high - low) / (right - left);
        for (i, series) in self.series.iter().enumerate() {
            let ink = series.policy.ink;
            if let Some(rate) = series.unshifted {
                chart.draw_series([dashes(vec![(low, rate), (high, rate)], ink)])?;
            }
            let shift = (i as f64 - (self.series.len() - 1) as f64 / 2.0) * APART * to_value;
            let points = series.points.iter().map(|(x, p)| (x + shift, p));
            match series.decay {
                Some(decay) => {
                    let first = series.points.first().map_or(low, |(x, _)| *x);
                    let last = series.points.last().map_or(high, |(x, _)| *x);
                    let x = (0..=CURVE).map(|i| first + (last - first) * f64::from(i) / f64::from(CURVE));
                    chart.draw_series(LineSeries::new(x.map(|x| (x, decay.at(x))), stroke(ink, 1.5)))?;
                }
                None => {
                    let rates = points.clone().map(|(x, p)| (x, p.rate));
                    chart.draw_series(LineSeries::new(rates, stroke(ink, 1.5)))?;
                }
            }
            let cap = units(7.0).unsigned_abs();
            chart.draw_series(
                points.clone().map(|(x, p)| ErrorBar::new_vertical(x, p.low, p.rate, p.high, stroke(ink, 1.5), cap)),
            )?;
            for (x, p) in points {
                let pixel = [left + (x - low) / to_value, bottom - p.rate * (bottom - top)];
                canvas.dot(pixel, 4.5, ink, true)?;
            }
        }
        Ok(())
    }
}
