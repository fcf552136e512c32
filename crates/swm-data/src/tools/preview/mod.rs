//! Previews of datasets: one video per selected episode, and a contact sheet of all selected episodes. Every frame
//! shows the labelled images of all cameras side by side.

mod label;
mod sheet;
mod video;

pub use sheet::contact_sheet;
pub(crate) use video::VideoFile;
pub use video::{check_mp4, integer_scale, write_mp4, write_mp4_scaled};

use crate::dataset::{Reader, StepRange};
use std::path::{Path, PathBuf};
use swm_core::{Batch, ColumnSpec, Error, Result, limits};
use swm_image::{check_png, write_png};

/// Settings of a preview.
#[derive(Clone, Debug)]
pub struct PreviewOptions {
    /// Number of episodes, which are spread evenly over the dataset.
    pub episodes: usize,
    /// The image columns to show; all if empty.
    pub columns: Vec<String>,
    /// Frame rate of the videos, in frames per second.
    pub fps: u32,
}

impl Default for PreviewOptions {
    fn default() -> Self {
        Self { episodes: 4, columns: vec![], fps: 15 }
    }
}

/// Number of frames per episode on the contact sheet.
const SHEET_COLUMNS: usize = 8;

/// Target side of enlarged images, in pixels.
const ENLARGED_SIDE: usize = 256;

/// Number of rows decoded at once, which limits the memory.
const ROWS: usize = 32;

/// Writes `episode_N.mp4` for each selected episode and one `contact_sheet.png` into a folder. Returns the paths. Calls
/// `progress` with the number of finished episodes.
///
/// # Errors
/// If the dataset has no images, lacks one of the columns or is damaged, the contact sheet would be too large, one of the
/// files exists and was not written by this program, or the folder cannot be written.
pub fn preview(
    reader: &dyn Reader,
    folder: &Path,
    options: &PreviewOptions,
    mut progress: impl FnMut(usize),
) -> Result<Vec<PathBuf>> {
    let layout = FrameLayout::new(reader, &options.columns)?;
    let chosen = chosen(reader, options.episodes)?;
    limits::SHEET_BYTES.check(limits::product([chosen.len(), SHEET_COLUMNS, layout.width, layout.height, 3]))?;
    let video_of = |episode: usize| folder.join(format!("episode_{}.mp4", reader.episodes()[episode].index));
    let contact_sheet_path = folder.join("contact_sheet.png");
    // Before any work, so that a refusal leaves no part of a preview.
    chosen.iter().try_for_each(|&episode| check_mp4(&video_of(episode)))?;
    check_png(&contact_sheet_path)?;
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "creating the folder", e))?;
    let (mut written, mut sheet) = (vec![], vec![]);
    let scale = integer_scale(layout.width, layout.height, ENLARGED_SIDE);
    for (done, &episode) in chosen.iter().enumerate() {
        let index = reader.episodes()[episode].index;
        let path = video_of(episode);
        let length = reader.episodes()[episode].length;
        let last = length - 1;
        let mut video = VideoFile::begin(&path, layout.width, layout.height, options.fps, scale)?;
        let on_sheet: Vec<usize> = (0..SHEET_COLUMNS).map(|i| i * last / (SHEET_COLUMNS - 1)).collect();
        for start in (0..length).step_by(ROWS) {
            let rows = ROWS.min(length - start);
            let batch = reader.read(&layout.names(), &[StepRange::new(episode, start, rows)])?;
            for row in 0..rows {
                let image = layout.draw(&batch, row, &format!("episode {index} step {}", start + row));
                video.add(&image)?;
                // Short episodes repeat frames on the sheet.
                let times = on_sheet.iter().filter(|&&step| step == start + row).count();
                sheet.extend(std::iter::repeat_n(image, times));
            }
        }
        video.finish()?;
        written.push(path);
        progress(done + 1);
    }
    let image = contact_sheet(layout.width, layout.height, &sheet, SHEET_COLUMNS, 1)?;
    write_png(&contact_sheet_path, image.width, image.height, &image.rgb)?;
    written.push(contact_sheet_path);
    Ok(written)
}

/// Positions of episodes spread evenly over the dataset.
fn chosen(reader: &dyn Reader, count: usize) -> Result<Vec<usize>> {
    let all: Vec<usize> = (0..reader.episodes().len()).filter(|&i| reader.episodes()[i].length > 0).collect();
    let count = count.min(all.len());
    if count == 0 {
        return Err(Error::config(
            "preview",
            "there is no episode to show",
            "collect episodes, or request at least one",
        ));
    }
    Ok((0..count).map(|i| all[i * all.len() / count]).collect())
}

/// Layout of a preview frame: the images of all cameras side by side below their labels.
struct FrameLayout {
    cameras: Vec<ColumnSpec>,
    width: usize,
    height: usize,
    /// Side of a letter's point in pixels.
    point: usize,
}

/// Pixels between two cameras.
const GAP: usize = 2;

impl FrameLayout {
    fn new(reader: &dyn Reader, names: &[String]) -> Result<Self> {
        let schema = reader.schema();
        let cameras: Vec<ColumnSpec> = if names.is_empty() {
            schema.columns().iter().filter(|column| column.is_image()).cloned().collect()
        } else {
            names.iter().map(|name| schema.column(name).cloned()).collect::<Result<_>>()?
        };
        if let Some(column) = cameras.iter().find(|column| !column.is_image()) {
            return Err(Error::mismatch(
                format!("previewing column '{}'", column.name),
                format!("{} {:?}", column.dtype.name(), column.shape),
                "images: uint8 [height, width, 3]",
            ));
        }
        let tallest = cameras.iter().map(|camera| camera.shape[0]).max();
        let Some(tallest) = tallest else {
            return Err(Error::config("preview", "the dataset has no images", "collect it with an image size"));
        };
        let point = (tallest / 112).max(1);
        let lines = 1 + usize::from(cameras.len() > 1);
        let wide: usize = cameras.iter().map(|camera| camera.shape[1]).sum::<usize>() + GAP * (cameras.len() - 1);
        // The title must fit, even if images are small.
        let width = wide.max(label::width("episode 0000 step 0000", point));
        Ok(Self { width, height: tallest + lines * label::height(point), point, cameras })
    }

    fn names(&self) -> Vec<&str> {
        self.cameras.iter().map(|camera| camera.name.as_str()).collect()
    }

    fn draw(&self, batch: &Batch, row: usize, title: &str) -> Vec<u8> {
        let mut rgb = vec![0; self.width * self.height * 3];
        label::draw(&mut rgb, self.width, (0, 0), self.width, self.point, title);
        let line = label::height(self.point);
        let (mut left, top) = (0, if self.cameras.len() > 1 { 2 * line } else { line });
        for (index, camera) in self.cameras.iter().enumerate() {
            let width = camera.shape[1];
            if self.cameras.len() > 1 {
                label::draw(&mut rgb, self.width, (left, line), left + width, self.point, &camera.name);
            }
            let image = &batch.bytes(index)[row * camera.row_bytes()..][..camera.row_bytes()];
            for (y, pixels) in image.chunks_exact(width * 3).enumerate() {
                let at = ((top + y) * self.width + left) * 3;
                rgb[at..at + pixels.len()].copy_from_slice(pixels);
            }
            left += width + GAP;
        }
        rgb
    }
}
