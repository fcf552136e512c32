//! [`FrameLayout`]: what a frame of a preview shows, and where.

use super::{colours, label};
use crate::dataset::Reader;
use swm_core::columns::{ACTION, DEPTH, REWARD, SEGMENTATION, SUCCESS};
use swm_core::{Batch, ColumnSpec, DType, Error, Result};

/// Least side of an enlarged image, in pixels.
const LEAST_SIDE: usize = 192;
/// Pixels between two cameras.
const GAP: usize = 2;
/// The most elements of an action that are shown.
const ACTION_ELEMENTS: usize = 6;

/// Layout of a preview frame: the images of all cameras below their labels, two side by side and more in a grid, and the values
/// of the step below.
pub(super) struct FrameLayout {
    cameras: Vec<ColumnSpec>,
    /// The columns whose values stand below the images.
    values: Vec<ColumnSpec>,
    /// The factor by which images are enlarged.
    scale: usize,
    /// Width of a frame in pixels.
    pub width: usize,
    /// Height of a frame in pixels.
    pub height: usize,
    /// Side of a letter's point in pixels.
    point: usize,
    /// The number of cameras side by side.
    columns: usize,
    /// Width and height of the cell of a camera, in pixels.
    cell: [usize; 2],
}

impl FrameLayout {
    /// Returns the layout for these columns; for all that can be shown, if there are none.
    pub fn new(reader: &dyn Reader, names: &[String]) -> Result<Self> {
        let schema = reader.schema();
        let cameras: Vec<ColumnSpec> = if names.is_empty() {
            schema.columns().iter().filter(|column| is_shown(column)).cloned().collect()
        } else {
            names.iter().map(|name| schema.column(name).cloned()).collect::<Result<_>>()?
        };
        if let Some(column) = cameras.iter().find(|column| !is_shown(column)) {
            return Err(Error::mismatch(
                format!("previewing column '{}'", column.name),
                format!("{} {:?}", column.dtype.name(), column.shape),
                "images (uint8 [height, width, 3]), depth (float32 [height, width]) or segmentation (int32 [height, width])",
            ));
        }
        let sides = cameras.iter().flat_map(|camera| &camera.shape[..2]).copied();
        let Some(longest) = sides.max() else {
            return Err(Error::config("preview", "the dataset has no images", "collect it with an image size"));
        };
        let scale = LEAST_SIDE.div_ceil(longest.max(1));
        let tallest = cameras.iter().map(|camera| camera.shape[0] * scale).max().unwrap_or_default();
        let point = (tallest / 112).max(1);
        let values: Vec<ColumnSpec> = [ACTION, REWARD, SUCCESS]
            .into_iter()
            .filter_map(|name| schema.columns().iter().find(|column| column.name == name && !column.is_image()))
            .cloned()
            .collect();
        let columns = if cameras.len() <= 2 {
            cameras.len()
        } else {
            cameras.len().isqrt() + usize::from(!is_square(cameras.len()))
        };
        let widest = cameras.iter().map(|camera| camera.shape[1] * scale).max().unwrap_or_default();
        let named = usize::from(cameras.len() > 1) * label::height(point);
        let cell = [widest + GAP, named + tallest + GAP];
        let rows = cameras.len().div_ceil(columns);
        // The title must fit, even if images are narrow.
        let width = (columns * cell[0] - GAP).max(label::width("episode 0000 step 0000", point));
        let height = rows * cell[1] - GAP + (1 + values.len()) * label::height(point);
        Ok(Self { width, height, point, scale, cameras, values, columns, cell })
    }

    /// The columns that a frame needs.
    pub fn names(&self) -> Vec<&str> {
        self.cameras.iter().chain(&self.values).map(|column| column.name.as_str()).collect()
    }

    /// Draws the frame of a row: `[height, width, 3]` RGB bytes.
    pub fn draw(&self, batch: &Batch, row: usize, title: &str) -> Result<Vec<u8>> {
        let mut rgb = vec![0; self.width * self.height * 3];
        label::draw(&mut rgb, self.width, (0, 0), self.width, self.point, title);
        let line = label::height(self.point);
        let named = if self.cameras.len() > 1 { line } else { 0 };
        let bottom = line + self.cameras.len().div_ceil(self.columns) * self.cell[1] - GAP;
        for (index, camera) in self.cameras.iter().enumerate() {
            let (height, width) = (camera.shape[0] * self.scale, camera.shape[1] * self.scale);
            let left = index % self.columns * self.cell[0];
            let top = line + index / self.columns * self.cell[1];
            if named > 0 {
                label::draw(&mut rgb, self.width, (left, top), left + width, self.point, &camera.name);
            }
            let top = top + named;
            let image = in_colour(camera, &batch.bytes(index)[row * camera.row_bytes()..][..camera.row_bytes()]);
            for y in 0..height {
                let from = &image[y / self.scale * camera.shape[1]..][..camera.shape[1]];
                let to = &mut rgb[((top + y) * self.width + left) * 3..][..width * 3];
                for (square, pixel) in to.chunks_exact_mut(self.scale * 3).zip(from) {
                    square.as_chunks_mut::<3>().0.fill(*pixel);
                }
            }
        }
        for (index, column) in self.values.iter().enumerate() {
            let text = format!("{} {}", column.name, in_words(&column.name, &batch.row(row).to_f64(&column.name)?));
            label::draw(&mut rgb, self.width, (0, bottom + index * line), self.width, self.point, &text);
        }
        Ok(rgb)
    }
}

/// Whether a number is a square.
fn is_square(number: usize) -> bool {
    number.isqrt().pow(2) == number
}

/// Whether a column can be shown: images, depth or segmentation.
fn is_shown(column: &ColumnSpec) -> bool {
    column.is_image() || (column.shape.len() == 2 && kind(column).is_some())
}

/// The modality of a column that holds depth or segmentation.
fn kind(column: &ColumnSpec) -> Option<&'static str> {
    let is = |modality: &str| {
        column.name == modality || column.name.strip_prefix(modality).is_some_and(|rest| rest.starts_with('.'))
    };
    match column.dtype {
        DType::Float32 if is(DEPTH) => Some(DEPTH),
        DType::Int32 if is(SEGMENTATION) => Some(SEGMENTATION),
        _ => None,
    }
}

/// Returns the pixels of a value of a column: of an image, or colours of depth (from the nearest to the farthest of the value) and of
/// segmentation.
///
/// # Shapes
/// `bytes` are those of one row; the result is `[height * width]`.
pub fn in_colour(column: &ColumnSpec, bytes: &[u8]) -> Vec<[u8; 3]> {
    let values = bytes.as_chunks::<4>().0;
    match kind(column) {
        Some(DEPTH) => colours::depths(&values.iter().map(|value| f32::from_ne_bytes(*value)).collect::<Vec<_>>()),
        Some(_) => colours::segments(&values.iter().map(|value| i32::from_ne_bytes(*value)).collect::<Vec<_>>()),
        None => bytes.as_chunks::<3>().0.to_vec(),
    }
}

/// Returns the values of a step as text.
fn in_words(name: &str, values: &[f64]) -> String {
    if name == SUCCESS {
        return if values.iter().any(|&value| value > 0.0) { "yes" } else { "no" }.to_owned();
    }
    if values.iter().all(|value| value.is_nan()) {
        return "-".to_owned();
    }
    let mut texts: Vec<String> = values.iter().take(ACTION_ELEMENTS).map(|value| format!("{value:.2}")).collect();
    if values.len() > ACTION_ELEMENTS {
        texts.push("...".to_owned());
    }
    texts.join(" ")
}
