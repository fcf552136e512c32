//! Success over a hue, which is the angle, and another variable, which is the distance from the centre.

use super::{Drawn, finish, scale};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, TEXT};
use crate::study::sheet::Sheet;
use crate::text::{escape, number, percent, shorten};
use plotters::style::{Color as _, HSLColor, RGBColor};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use swm_core::Result;

/// The largest numbers of policies, hues and rings.
const MOST: [usize; 3] = [6, 72, 12];
/// The width of the ring of hues.
const HUES: f64 = 7.0;
/// The space for the degrees outside of the map.
const DEGREES: f64 = 30.0;
/// The height of the name of a policy.
const NAME: f64 = 24.0;
/// The share of the radius that the centre has.
const CENTRE: f64 = 0.2;
/// The space for a value of a cell.
const VALUE: [f64; 2] = [24.0, 15.0];

/// The wheel of one policy.
struct Wheel {
    policy: String,
    /// The rates, by the indices of hue and ring.
    rates: BTreeMap<[usize; 2], f64>,
    /// The rate of the condition that is not shifted.
    centre: Option<f64>,
}

struct Wheels {
    /// Hues in degrees, in ascending order.
    hues: Vec<f64>,
    /// The values of the other variable, from the centre outwards.
    rings: Vec<f64>,
    wheels: Vec<Wheel>,
}

/// Draws a wheel for each policy; `points` are hues, values of the other variable, and conditions.
pub(super) fn draw(
    sheet: &Sheet<'_>,
    counting: usize,
    hue: &str,
    other: Option<&str>,
    points: &[([f64; 2], usize)],
) -> Result<Vec<Drawn>> {
    let distinct = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|(at, _)| at[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        values.truncate(MOST[1 + axis]);
        values
    };
    let (hues, rings) = (distinct(0), distinct(1));
    let share = |condition: usize, policy: usize| {
        let rate = sheet.row(condition, policy, counting)?.success.rate;
        (0.0..=1.0).contains(&rate).then_some(rate)
    };
    let wheel = |(i, policy): (usize, &crate::study::sheet::Policy<'_>)| {
        let rates = points.iter().filter_map(|(at, condition)| {
            let index = |values: &[f64], value: f64| values.iter().position(|other| *other == value);
            Some(([index(&hues, at[0])?, index(&rings, at[1])?], share(*condition, i)?))
        });
        let centre = sheet.unshifted.and_then(|condition| share(condition, i));
        Wheel { policy: shorten(policy.name, 200), rates: rates.collect(), centre }
    };
    let wheels = sheet.policies.iter().enumerate().map(wheel).filter(|wheel| !wheel.rates.is_empty());
    let wheels: Vec<Wheel> = wheels.take(MOST[0]).collect();
    if wheels.is_empty() {
        return Ok(vec![]);
    }
    let mut caption = format!("The success rate, in percent. The angle is {}, in degrees", escape(&shorten(hue, 60)));
    if let Some(other) = other {
        let values: Vec<String> = rings.iter().map(|value| number(*value)).collect();
        caption +=
            &format!("; rings from the centre outwards are {} {}", escape(&shorten(other, 60)), values.join(", "));
    }
    caption += ". The outermost ring shows the hues.";
    if let Some(unshifted) = sheet.unshifted {
        caption += &format!(" The centre is “{}”.", escape(&shorten(sheet.conditions[unshifted], 60)));
    }
    let over = other.map_or(String::new(), |other| format!(" and {}", escape(&shorten(other, 60))));
    let heading = format!("Success over {}{over}", escape(&shorten(hue, 60)));
    finish("wheel", heading, caption, &Wheels { hues, rings, wheels })
}

impl Wheels {
    /// The number of wheels in a line, and the width of each.
    fn columns(&self, layout: Layout) -> (usize, f64) {
        match (layout, self.wheels.len()) {
            (Layout::Narrow, _) => (1, layout.width()),
            (Layout::Wide, 1 | 2) => (2, 440.0),
            (Layout::Wide, 4) => (2, 340.0),
            (Layout::Wide, _) => (3, layout.width() / 3.0),
        }
    }

    /// The first and the last angle of a hue, in degrees: half-way to the neighbouring hues.
    fn sector(&self, hue: usize) -> [f64; 2] {
        let (n, middle) = (self.hues.len(), self.hues[hue]);
        let before = if hue == 0 { self.hues[n - 1] - 360.0 } else { self.hues[hue - 1] };
        let after = if hue + 1 == n { self.hues[0] + 360.0 } else { self.hues[hue + 1] };
        [f64::midpoint(before, middle), f64::midpoint(middle, after)]
    }

    fn wheel<B: Surface>(&self, canvas: &Canvas<B>, wheel: &Wheel, corner: [f64; 2], width: f64) -> Painted<B> {
        let name = canvas.fit(TEXT, &wheel.policy, width - 12.0);
        canvas.text([corner[0] + width / 2.0, corner[1] + NAME / 2.0], Anchor::Middle, TEXT, Ink::Text, &name)?;
        let centre = [corner[0] + width / 2.0, corner[1] + NAME + width / 2.0];
        let radius = width / 2.0 - DEGREES;
        let map = radius - HUES - 2.0;
        let ring = map * (1.0 - CENTRE) / self.rings.len() as f64;
        for (&[hue, index], &rate) in &wheel.rates {
            let inner = map * CENTRE + index as f64 * ring;
            let fill = scale::colour(rate);
            let sector = self.sector(hue);
            canvas.polygon(&piece(centre, [inner, inner + ring], sector), fill.filled())?;
            let middle = inner + ring / 2.0;
            let arc = middle * (sector[1] - sector[0]).to_radians();
            if ring >= VALUE[1] && arc >= VALUE[0] {
                let at = polar(centre, middle, f64::midpoint(sector[0], sector[1]));
                canvas.text(at, Anchor::Middle, SMALL, Ink::on(fill), &format!("{:.0}", 100.0 * rate))?;
            }
        }
        if let Some(rate) = wheel.centre {
            let fill = scale::colour(rate);
            canvas.polygon(&piece(centre, [0.0, map * CENTRE], [0.0, 360.0]), fill.filled())?;
            canvas.text(centre, Anchor::Middle, SMALL, Ink::on(fill), &format!("{:.0}", 100.0 * rate))?;
        }
        self.degrees(canvas, centre, radius)
    }

    /// Draws the ring of hues, and degrees outside of it.
    fn degrees<B: Surface>(&self, canvas: &Canvas<B>, centre: [f64; 2], radius: f64) -> Painted<B> {
        for hue in 0..self.hues.len() {
            let (red, green, blue) = HSLColor(self.hues[hue] / 360.0, 1.0, 0.5).rgb();
            let fill = RGBColor(red, green, blue).filled();
            canvas.polygon(&piece(centre, [radius - HUES, radius], self.sector(hue)), fill)?;
        }
        for degrees in (0..360).step_by(60) {
            let at = polar(centre, radius + DEGREES / 2.0, f64::from(degrees));
            canvas.text(at, Anchor::Middle, SMALL, Ink::Soft, &format!("{degrees}°"))?;
        }
        Ok(())
    }
}

/// The point at a distance and an angle in degrees; 0 is at the top, and angles grow clockwise.
fn polar([x, y]: [f64; 2], distance: f64, degrees: f64) -> [f64; 2] {
    let angle = degrees / 360.0 * TAU;
    [x + distance * angle.sin(), y - distance * angle.cos()]
}

/// The outline of a part of a ring.
fn piece(centre: [f64; 2], [inner, outer]: [f64; 2], [from, to]: [f64; 2]) -> Vec<[f64; 2]> {
    let steps = ((to - from).abs() / 3.0).ceil().clamp(1.0, 120.0) as u32;
    let angle = |i: u32| from + (to - from) * f64::from(i) / f64::from(steps);
    let out = (0..=steps).map(|i| polar(centre, outer, angle(i)));
    let back = (0..=steps).rev().map(|i| polar(centre, inner, angle(i)));
    if inner > 0.0 { out.chain(back).collect() } else { out.chain([centre]).collect() }
}

impl Figure for Wheels {
    fn height(&self, layout: Layout) -> f64 {
        let (columns, width) = self.columns(layout);
        self.wheels.len().div_ceil(columns) as f64 * (NAME + width) + scale::HEIGHT + 4.0
    }

    fn description(&self) -> String {
        let wheel = |wheel: &Wheel| {
            let rate = |(&[hue, ring], rate): (&[usize; 2], &f64)| {
                format!("{} at {}°, {}", percent(*rate), number(self.hues[hue]), number(self.rings[ring]))
            };
            format!("{}: {}", wheel.policy, wheel.rates.iter().map(rate).collect::<Vec<_>>().join("; "))
        };
        format!("Success over hue. {}", self.wheels.iter().map(wheel).collect::<Vec<_>>().join(". "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let (columns, width) = self.columns(canvas.layout);
        let left = (canvas.width() - columns.min(self.wheels.len()) as f64 * width) / 2.0;
        for (i, wheel) in self.wheels.iter().enumerate() {
            let corner = [left + (i % columns) as f64 * width, (i / columns) as f64 * (NAME + width)];
            self.wheel(canvas, wheel, corner, width)?;
        }
        let top = self.wheels.len().div_ceil(columns) as f64 * (NAME + width);
        scale::legend(canvas, [(canvas.width() - 240.0) / 2.0, top], 240.0)
    }
}
