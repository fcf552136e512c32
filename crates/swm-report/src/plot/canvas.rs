//! [`Canvas`]: what figures are drawn on.

use super::{EM, FONT, Ink, Layout, UNIT};
use crate::text::{escape, plain};
use plotters::backend::{BitMapBackend, DrawingBackend, SVGBackend};
use plotters::chart::{ChartBuilder, ChartContext, LabelAreaPosition};
use plotters::coord::Shift;
use plotters::coord::cartesian::Cartesian2d;
use plotters::coord::types::RangedCoordf64;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind};
use plotters::element::{Circle, DashedPathElement, EmptyElement, PathElement, Polygon, Rectangle, Text};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{Color as _, IntoFont as _, ShapeStyle, TRANSPARENT, TextStyle};
use std::cell::RefCell;
use std::fmt::Write as _;
use std::ops::Range;

/// Size of headings, in pixels.
pub(crate) const HEADING: f64 = 14.5;
/// Size of names and values, in pixels.
pub(crate) const TEXT: f64 = 13.0;
/// Size of ticks and notes, in pixels.
pub(crate) const SMALL: f64 = 11.5;

/// The outcome of drawing.
pub(crate) type Drawn<B> = Result<(), DrawingAreaErrorKind<<B as DrawingBackend>::ErrorType>>;

/// A chart with two linear axes.
pub(crate) type Chart<'a, B> = ChartContext<'a, B, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// How the ticks of an axis are written.
pub(crate) type Ticks<'a> = &'a dyn Fn(&f64) -> String;

/// A backend of plotters.
pub(crate) trait Surface: DrawingBackend {
    /// How far below the middle of a line the backend draws it, in em.
    const TEXT_OFFSET: f64;
}

impl Surface for SVGBackend<'_> {
    const TEXT_OFFSET: f64 = 0.0;
}

impl Surface for BitMapBackend<'_> {
    const TEXT_OFFSET: f64 = -0.14;
}

/// Where a text begins, horizontally.
#[derive(Clone, Copy)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

/// What a figure is drawn on. Coordinates are pixels from the top left corner.
pub(crate) struct Canvas<B: DrawingBackend> {
    pub(crate) area: DrawingArea<B, Shift>,
    pub(crate) layout: Layout,
    width: f64,
    /// Parts of the drawing with a tooltip or a link, as SVG elements above all others.
    overlay: RefCell<String>,
}

/// A length in units.
pub(crate) fn units(pixels: f64) -> i32 {
    // Values come from files; a drawing has no place for those far outside it.
    if pixels.is_finite() { (pixels.clamp(-1e5, 1e5) * UNIT).round() as i32 } else { 0 }
}

/// A line of a width in pixels.
pub(crate) fn stroke(ink: Ink, width: f64) -> ShapeStyle {
    ink.rgb().stroke_width(units(width).unsigned_abs())
}

/// A text of a size in pixels.
pub(crate) fn text_style(ink: Ink, size: f64) -> TextStyle<'static> {
    (FONT, size * UNIT * EM).into_font().color(&ink.rgb())
}

impl<B: Surface> Canvas<B> {
    /// A canvas of a width in pixels.
    pub(super) fn new(area: DrawingArea<B, Shift>, layout: Layout, width: f64) -> Self {
        Self { area, layout, width, overlay: RefCell::default() }
    }

    /// The width, in pixels.
    pub(crate) fn width(&self) -> f64 {
        self.width
    }

    pub(crate) fn line(&self, points: &[[f64; 2]], style: ShapeStyle) -> Drawn<B> {
        let points: Vec<(i32, i32)> = points.iter().map(|[x, y]| (units(*x), units(*y))).collect();
        self.area.draw(&PathElement::new(points, style))
    }

    /// Draws a dashed line.
    pub(crate) fn dashed(&self, points: &[[f64; 2]], ink: Ink, width: f64) -> Drawn<B> {
        let points: Vec<(i32, i32)> = points.iter().map(|[x, y]| (units(*x), units(*y))).collect();
        self.area.draw(&DashedPathElement::new(points, units(5.0), units(4.0), stroke(ink, width)))
    }

    pub(crate) fn rect(&self, [x, y]: [f64; 2], [width, height]: [f64; 2], style: ShapeStyle) -> Drawn<B> {
        self.area.draw(&Rectangle::new([(units(x), units(y)), (units(x + width), units(y + height))], style))
    }

    /// Draws the outline of a rectangle, inside its edges.
    pub(crate) fn outline(&self, [x, y]: [f64; 2], [width, height]: [f64; 2], ink: Ink, line: f64) -> Drawn<B> {
        let (half, [right, bottom]) = (line / 2.0, [x + width - line / 2.0, y + height - line / 2.0]);
        let corners = [[x + half, y + half], [right, y + half], [right, bottom], [x + half, bottom]];
        let closed = [&corners[..], &[[x, y + half]]].concat();
        self.line(&closed, stroke(ink, line))
    }

    pub(crate) fn polygon(&self, points: &[[f64; 2]], style: ShapeStyle) -> Drawn<B> {
        let points: Vec<(i32, i32)> = points.iter().map(|[x, y]| (units(*x), units(*y))).collect();
        self.area.draw(&Polygon::new(points, style))
    }

    /// Draws a dot with an outline in the colour of the background, or a ring if it is not filled.
    pub(crate) fn dot(&self, [x, y]: [f64; 2], radius: f64, ink: Ink, filled: bool) -> Drawn<B> {
        let at = (units(x), units(y));
        let (outer, inner) = if filled { (Ink::Surface, ink) } else { (ink, Ink::Surface) };
        self.area.draw(&Circle::new(at, units(radius + 0.8), outer.rgb().filled()))?;
        self.area.draw(&Circle::new(at, units(radius - 0.8), inner.rgb().filled()))
    }

    /// Draws a ring around what is drawn already.
    pub(crate) fn ring(&self, [x, y]: [f64; 2], radius: f64, ink: Ink) -> Drawn<B> {
        self.area.draw(&Circle::new((units(x), units(y)), units(radius), stroke(ink, 1.6)))
    }

    /// Draws a text whose line is centred at `y`.
    pub(crate) fn text(&self, [x, y]: [f64; 2], anchor: Anchor, size: f64, ink: Ink, words: &str) -> Drawn<B> {
        let h_pos = match anchor {
            Anchor::Start => HPos::Left,
            Anchor::Middle => HPos::Center,
            Anchor::End => HPos::Right,
        };
        let style = text_style(ink, size).pos(Pos::new(h_pos, VPos::Center));
        let at = (units(x), units(y - B::TEXT_OFFSET * size));
        self.area.draw(&(EmptyElement::at(at) + Text::new(plain(words), (0, 0), style)))
    }

    /// Gives a rectangle a tooltip. A page shows it; other forms of the figure do not have it.
    pub(crate) fn tip(&self, corner: [f64; 2], size: [f64; 2], words: &str) {
        // Narrow screens have no pointer that could rest on a part of the figure.
        if self.layout == Layout::Wide {
            self.cover(corner, size, &format!("><title>{}</title></rect>\n", escape(words)));
        }
    }

    /// Gives a rectangle a tooltip, and a link to an element of the page.
    pub(crate) fn link(&self, corner: [f64; 2], size: [f64; 2], words: &str, id: &str) {
        let id = escape(id);
        let _ = write!(self.overlay.borrow_mut(), "<a href=\"#{id}\">");
        self.cover(corner, size, &format!("><title>{}</title></rect></a>\n", escape(words)));
    }

    fn cover(&self, corner: [f64; 2], size: [f64; 2], end: &str) {
        let ([x, y], [width, height]) = (corner.map(units), size.map(units));
        let mut overlay = self.overlay.borrow_mut();
        let _ = write!(overlay, "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"{end}");
    }

    /// The elements with tooltips and links; nothing if there are none.
    pub(super) fn overlay(&self) -> String {
        let overlay = self.overlay.borrow();
        if overlay.is_empty() { String::new() } else { format!("<g class=\"over\">\n{overlay}</g>\n") }
    }

    /// The width of a text, in pixels.
    pub(crate) fn measure(&self, size: f64, words: &str) -> f64 {
        // Scripts that the font does not have are drawn with another font, and are at most as wide as high.
        let foreign = words.chars().filter(|c| u32::from(*c) >= 0x530 && !('\u{2000}'..'\u{2e00}').contains(c)).count();
        let width =
            self.area.estimate_text_size(words, &text_style(Ink::Text, size)).map_or(0.0, |(width, _)| width.into());
        width / UNIT + 0.6 * size * foreign as f64
    }

    /// The text, truncated with an ellipsis to a width in pixels.
    pub(crate) fn fit(&self, size: f64, words: &str, width: f64) -> String {
        if self.measure(size, words) <= width {
            return words.to_owned();
        }
        let mut short = String::new();
        for c in words.chars() {
            short.push(c);
            if self.measure(size, &format!("{short}…")) > width {
                short.pop();
                break;
            }
        }
        format!("{}…", short.trim_end())
    }

    /// A chart whose data lie between the corners `[left, top]` and `[right, bottom]`, with a grid along `x` below which
    /// are ticks, and along `y` if `y_ticks` says how to write them.
    pub(crate) fn chart<'a>(
        &'a self,
        [left, top, right, bottom]: [f64; 4],
        (x, x_ticks): (Range<f64>, Ticks<'_>),
        (y, y_ticks): (Range<f64>, Option<Ticks<'_>>),
    ) -> Result<Chart<'a, B>, DrawingAreaErrorKind<B::ErrorType>> {
        let height = self.area.dim_in_pixel().1;
        let label = if y_ticks.is_some() { 44.0_f64.min(left) } else { 0.0 };
        let mut chart = ChartBuilder::on(&self.area)
            .margin_left(units(left - label))
            .margin_right(units(self.width() - right))
            .margin_top(units(top))
            .margin_bottom(height as i32 - units(bottom + 24.0))
            .x_label_area_size(units(24.0))
            .y_label_area_size(units(label))
            .build_cartesian_2d(x, y)?;
        let grid = stroke(Ink::Grid, 1.0);
        let count = match right - left {
            wide if wide > 400.0 => 8,
            wide if wide > 300.0 => 6,
            _ => 4,
        };
        let mut mesh = chart.configure_mesh();
        mesh.light_line_style(TRANSPARENT)
            .bold_line_style(grid)
            .axis_style(grid)
            .set_tick_mark_size(LabelAreaPosition::Bottom, units(3.0))
            .x_labels(count)
            .y_labels(6)
            .label_style(text_style(Ink::Soft, SMALL))
            .x_label_formatter(&x_ticks);
        match &y_ticks {
            Some(ticks) => mesh.y_label_formatter(ticks),
            None => mesh.disable_y_mesh().disable_y_axis(),
        };
        mesh.draw()?;
        Ok(chart)
    }
}
