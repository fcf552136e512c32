//! Drawings with `plotters`: each figure is drawn once per layout and format, as SVG and as PNG.
//!
//! Plotters' coordinates are integers. A drawing therefore has [`UNIT`] units for each pixel, which the SVG's view box and
//! the scaling of the PNG divide again.

mod ink;

pub(crate) use ink::{Ink, theme_rules};

use crate::text::{escape, plain, shorten};
use base64::Engine as _;
use plotters::backend::{BitMapBackend, DrawingBackend, SVGBackend};
use plotters::chart::{ChartBuilder, ChartContext, LabelAreaPosition};
use plotters::coord::Shift;
use plotters::coord::cartesian::Cartesian2d;
use plotters::coord::types::RangedCoordf64;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind, IntoDrawingArea};
use plotters::element::{Circle, EmptyElement, PathElement, Polygon, Rectangle, Text};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{Color as _, FontStyle, IntoFont as _, ShapeStyle, TRANSPARENT, TextStyle, register_font};
use std::ops::Range;
use std::sync::OnceLock;
use swm_core::{Error, Result};

/// Units of a drawing for each pixel.
const UNIT: f64 = 4.0;
/// Units of a drawing for each pixel of a PNG, which is thus drawn with 2 × 2 samples a pixel.
const SAMPLES: usize = 2;
/// The font of all texts; the others replace it where a program does not have it.
const FONT: &str = "Roboto, Arial, Helvetica, sans-serif";
/// The font itself: texts are measured with it, so they fit wherever the drawing is shown with it.
const FONT_FILE: &[u8] = include_bytes!("../../fonts/Roboto-subset.ttf");
/// Plotters draws texts of size 1.24 with an em of 1.
const EM: f64 = 1.24;

/// Size of names and values, in pixels.
pub(crate) const TEXT: f64 = 13.0;
/// Size of ticks and notes, in pixels.
pub(crate) const SMALL: f64 = 11.5;

/// The widths that a figure is drawn for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Layout {
    /// Names beside the data.
    Wide,
    /// Names above the data, for narrow screens.
    Narrow,
}

impl Layout {
    /// The width, in pixels.
    pub(crate) fn width(self) -> f64 {
        match self {
            Self::Wide => 880.0,
            Self::Narrow => 340.0,
        }
    }

    fn class(self) -> &'static str {
        match self {
            Self::Wide => "chart for-wide",
            Self::Narrow => "chart for-narrow",
        }
    }
}

/// A figure that can be drawn in any layout.
pub(crate) trait Figure {
    /// The height, in pixels.
    fn height(&self, layout: Layout) -> f64;

    /// What the figure shows, for screen readers.
    fn description(&self) -> String;

    /// Draws the figure.
    ///
    /// # Errors
    /// When the backend fails.
    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Drawn<B>;
}

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
    /// The width, in pixels.
    pub(crate) fn width(&self) -> f64 {
        self.layout.width()
    }

    pub(crate) fn line(&self, points: &[[f64; 2]], style: ShapeStyle) -> Drawn<B> {
        let points: Vec<(i32, i32)> = points.iter().map(|[x, y]| (units(*x), units(*y))).collect();
        self.area.draw(&PathElement::new(points, style))
    }

    pub(crate) fn rect(&self, [x, y]: [f64; 2], [width, height]: [f64; 2], style: ShapeStyle) -> Drawn<B> {
        self.area.draw(&Rectangle::new([(units(x), units(y)), (units(x + width), units(y + height))], style))
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
        let count = if self.layout == Layout::Wide { 8 } else { 4 };
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

/// A figure in all its forms.
pub(crate) struct Drawing {
    /// The elements for the page, one for each layout.
    pub(crate) inline: String,
    /// A file for a paper.
    pub(crate) svg: String,
    /// An image of twice the size.
    pub(crate) png: Vec<u8>,
}

/// Draws a figure.
///
/// # Errors
/// When drawing fails, which is a bug.
pub(crate) fn draw(figure: &impl Figure) -> Result<Drawing> {
    static REGISTERED: OnceLock<bool> = OnceLock::new();
    if !REGISTERED.get_or_init(|| register_font(FONT, FontStyle::Normal, FONT_FILE).is_ok()) {
        return Err(Error::external("reading the font of figures", std::io::Error::other("not a font")));
    }
    let description = escape(&shorten(&figure.description(), 2000));
    let mut inline = String::new();
    for layout in [Layout::Wide, Layout::Narrow] {
        let size = [layout.width(), figure.height(layout)];
        let [width, height] = size.map(units);
        let start = format!(
            "<svg class=\"{}\" role=\"img\" aria-label=\"{description}\" viewBox=\"0 0 {width} {height}\" \
             xmlns=\"http://www.w3.org/2000/svg\">\n",
            layout.class()
        );
        inline += &(start + &elements(figure, layout)?);
    }
    let size = [Layout::Wide.width(), figure.height(Layout::Wide)];
    let [width, height] = size.map(units);
    let svg = format!(
        "<svg width=\"{}\" height=\"{}\" viewBox=\"0 0 {width} {height}\" xmlns=\"http://www.w3.org/2000/svg\">\n\
         <title>{description}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#FFFFFF\"/>\n{}",
        size[0],
        size[1],
        elements(figure, Layout::Wide)?
    );
    Ok(Drawing { inline, svg, png: png(figure)? })
}

/// The elements of a figure and the end of its SVG element.
fn elements(figure: &impl Figure, layout: Layout) -> Result<String> {
    let mut svg = String::new();
    let size = [layout.width(), figure.height(layout)].map(|length| units(length).unsigned_abs());
    {
        let area = SVGBackend::with_string(&mut svg, (size[0], size[1])).into_drawing_area();
        let canvas = Canvas { area, layout };
        let drawn = figure.draw(&canvas).and_then(|()| canvas.area.present());
        drawn.map_err(|error| Error::external("drawing a figure as SVG", error))?;
    }
    // The start of the element has the size in units.
    let start = svg.find(">\n").map_or(0, |end| end + 2);
    Ok(svg.split_off(start).replace(" opacity=\"1\"", "").replace("\n</text>", "</text>"))
}

fn png(figure: &impl Figure) -> Result<Vec<u8>> {
    let layout = Layout::Wide;
    let size = [layout.width(), figure.height(layout)].map(|length| units(length).unsigned_abs() as usize);
    let [width, height] = size.map(|length| length - length % SAMPLES);
    let mut samples = vec![255; width * height * 3];
    {
        let area = BitMapBackend::with_buffer(&mut samples, (width as u32, height as u32)).into_drawing_area();
        let canvas = Canvas { area, layout };
        let drawn = figure.draw(&canvas).and_then(|()| canvas.area.present());
        drawn.map_err(|error| Error::external("drawing a figure as PNG", error))?;
    }
    let (columns, rows) = (width / SAMPLES, height / SAMPLES);
    let mut pixels = Vec::with_capacity(columns * rows * 3);
    for row in 0..rows {
        for column in 0..columns {
            for channel in 0..3 {
                let at = |y: usize, x: usize| {
                    usize::from(samples[((row * SAMPLES + y) * width + column * SAMPLES + x) * 3 + channel])
                };
                let sum: usize = (0..SAMPLES * SAMPLES).map(|i| at(i / SAMPLES, i % SAMPLES)).sum();
                pixels.push((sum / (SAMPLES * SAMPLES)) as u8);
            }
        }
    }
    let mut file = vec![];
    encode(&pixels, rows, columns, &mut file).map_err(|error| Error::external("encoding a figure as PNG", error))?;
    Ok(file)
}

/// Appends an RGB image as a PNG file, as small as the encoder makes it.
fn encode(pixels: &[u8], rows: usize, columns: usize, file: &mut Vec<u8>) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(file, columns as u32, rows as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()
}

/// The rule of a style sheet that contains the font of drawings.
pub(crate) fn font_rule() -> String {
    let data = base64::engine::general_purpose::STANDARD.encode(FONT_FILE);
    format!("@font-face {{ font-family: Roboto; src: url(data:font/ttf;base64,{data}); }}\n")
}

/// The size of a drawing, and the corners and words of its texts, in pixels; for tests of their geometry.
#[cfg(test)]
pub(crate) fn text_boxes(svg: &str) -> ([f64; 2], Vec<([f64; 4], String)>) {
    let attribute = |tag: &str, name: &str| {
        let value = tag.split(&format!(" {name}=\"")).nth(1).and_then(|rest| rest.split('"').next());
        value.unwrap_or_else(|| panic!("{name} of {tag}")).to_owned()
    };
    let number = |tag: &str, name: &str| attribute(tag, name).parse::<f64>().expect("a number") / UNIT;
    let view = attribute(svg, "viewBox");
    let size: Vec<f64> = view.split(' ').skip(2).map(|side| side.parse::<f64>().expect("a side") / UNIT).collect();
    let text = |element: &str| {
        let (tag, rest) = element.split_once('>').expect("a tag");
        let words = rest.split("</text").next().unwrap_or_default().trim().to_owned();
        let drawn = words.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&").replace("&quot;", "\"");
        let em = number(tag, "font-size");
        let font = (FONT, em * UNIT * EM).into_font();
        let width = font.box_size(&drawn.replace("&apos;", "'")).map_or(0.0, |(width, _)| f64::from(width)) / UNIT;
        let left = number(tag, "x")
            - width
                * [("start", 0.0), ("middle", 0.5), ("end", 1.0)]
                    .iter()
                    .find(|(anchor, _)| *anchor == attribute(tag, "text-anchor"))
                    .map_or(0.0, |(_, share)| *share);
        let down = if attribute(tag, "dy") == "0.5ex" { 0.26 } else { 0.76 };
        let base = number(tag, "y") + down * em;
        ([left, base - 0.75 * em, left + width, base + 0.21 * em], words)
    };
    ([size[0], size[1]], svg.split("<text").skip(1).map(text).collect())
}
