//! Drawings with `plotters`: each figure is drawn once per layout and format, as SVG and as PNG.
//!
//! Plotters' coordinates are integers. A drawing therefore has [`UNIT`] units for each pixel, which the SVG's view box and
//! the scaling of the PNG divide again.
//!
//! Plotters draws no tooltips and no links. A figure gives them to parts of its canvas ([`Canvas::tip`],
//! [`Canvas::link`]), and a page has them as transparent elements above the drawing.

mod canvas;
mod ink;

pub(crate) use canvas::{Anchor, Canvas, Drawn, HEADING, SMALL, Surface, TEXT, stroke, units};
pub(crate) use ink::{Ink, inks, theme_rules};

use crate::text::{escape, shorten};
use base64::Engine as _;
use plotters::backend::{BitMapBackend, SVGBackend};
use plotters::drawing::IntoDrawingArea;
#[cfg(test)]
use plotters::style::IntoFont as _;
use plotters::style::{FontStyle, register_font};
use std::fmt::Write as _;
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
    /// The width, in pixels.
    fn width(&self, layout: Layout) -> f64 {
        layout.width()
    }

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

/// A figure in all its forms.
pub(crate) struct Drawing {
    /// The elements for the page, one for each layout.
    pub(crate) inline: String,
    /// A file for a paper.
    pub(crate) svg: String,
    /// An image of twice the size.
    pub(crate) png: Vec<u8>,
}

/// Draws a figure in all its forms.
///
/// # Errors
/// When drawing fails, which is a bug.
pub(crate) fn draw(figure: &impl Figure) -> Result<Drawing> {
    Ok(Drawing { inline: inline(figure)?, svg: svg(figure)?, png: png(figure)? })
}

/// Draws a figure as an SVG file.
///
/// # Errors
/// When drawing fails, which is a bug.
pub(crate) fn svg(figure: &impl Figure) -> Result<String> {
    let [width, height] = size(figure, Layout::Wide);
    Ok(format!(
        "<svg width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {} {}\" xmlns=\"http://www.w3.org/2000/svg\">\n\
         <title>{}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#FFFFFF\"/>\n{}</svg>\n",
        units(width),
        units(height),
        description(figure),
        elements(figure, Layout::Wide)?.0
    ))
}

/// Draws a figure for a page: an element for each layout.
///
/// # Errors
/// When drawing fails, which is a bug.
pub(crate) fn inline(figure: &impl Figure) -> Result<String> {
    let description = description(figure);
    let mut svg = String::new();
    for layout in [Layout::Wide, Layout::Narrow] {
        let [width, height] = size(figure, layout).map(units);
        let (drawn, overlay) = elements(figure, layout)?;
        // The style sheet has the font, and nothing else is the default.
        let drawn = drawn.replace(&format!(" font-family=\"{FONT}\""), "").replace(" stroke=\"none\"", "");
        let _ = write!(
            svg,
            "<svg class=\"{}\" role=\"img\" aria-label=\"{description}\" viewBox=\"0 0 {width} {height}\" \
             xmlns=\"http://www.w3.org/2000/svg\">\n{drawn}{overlay}</svg>\n",
            layout.class()
        );
    }
    Ok(svg)
}

fn description(figure: &impl Figure) -> String {
    escape(&shorten(&figure.description(), 2000))
}

/// The size of a figure, in pixels.
fn size(figure: &impl Figure, layout: Layout) -> [f64; 2] {
    [figure.width(layout), figure.height(layout)]
}

/// The elements of a figure, and those with tooltips and links.
fn elements(figure: &impl Figure, layout: Layout) -> Result<(String, String)> {
    static REGISTERED: OnceLock<bool> = OnceLock::new();
    if !REGISTERED.get_or_init(|| register_font(FONT, FontStyle::Normal, FONT_FILE).is_ok()) {
        return Err(Error::external("reading the font of figures", std::io::Error::other("not a font")));
    }
    let mut svg = String::new();
    let [width, height] = size(figure, layout);
    let overlay = {
        let [columns, rows] = [width, height].map(|length| units(length).unsigned_abs());
        let area = SVGBackend::with_string(&mut svg, (columns, rows)).into_drawing_area();
        let canvas = Canvas::new(area, layout, width);
        let drawn = figure.draw(&canvas).and_then(|()| canvas.area.present());
        drawn.map_err(|error| Error::external("drawing a figure as SVG", error))?;
        canvas.overlay()
    };
    // The start of the element has the size in units.
    let start = svg.find(">\n").map_or(0, |end| end + 2);
    let drawn = svg.split_off(start).replace(" opacity=\"1\"", "").replace("\n</text>", "</text>");
    // Readers of XML know `&apos;`; those of old HTML do not.
    let drawn = drawn.replace("&apos;", "&#39;");
    Ok((drawn.trim_end().trim_end_matches("</svg>").to_owned(), overlay))
}

fn png(figure: &impl Figure) -> Result<Vec<u8>> {
    let layout = Layout::Wide;
    let size = size(figure, layout);
    let [width, height] = size.map(|length| units(length).unsigned_abs() as usize).map(|side| side - side % SAMPLES);
    let mut samples = vec![255; width * height * 3];
    {
        let area = BitMapBackend::with_buffer(&mut samples, (width as u32, height as u32)).into_drawing_area();
        let canvas = Canvas::new(area, layout, size[0]);
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

/// Checks, in every layout of a figure, that no text overlaps another or leaves the drawing, and that there are more than
/// `least` texts.
#[cfg(test)]
pub(crate) fn check_texts(inline: &str, least: usize) {
    for svg in inline.split("<svg class=\"chart").skip(1) {
        let (size, boxes) = text_boxes(svg.split("</svg>").next().unwrap_or_default());
        assert!(boxes.len() > least, "{svg}");
        for (i, (a, words)) in boxes.iter().enumerate() {
            let inside = a[0] >= -1.0 && a[1] >= -1.0 && a[2] <= size[0] + 1.0 && a[3] <= size[1] + 1.0;
            assert!(inside, "“{words}” at {a:?} leaves {size:?}");
            for (b, other) in &boxes[i + 1..] {
                let apart = a[2] <= b[0] || b[2] <= a[0] || a[3] <= b[1] || b[3] <= a[1];
                assert!(apart, "“{words}” {a:?} overlaps “{other}” {b:?}");
            }
        }
    }
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
        let width = font.box_size(&drawn.replace("&#39;", "'")).map_or(0.0, |(width, _)| f64::from(width)) / UNIT;
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
