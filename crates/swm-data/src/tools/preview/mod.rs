//! Previews of datasets: one video per selected episode, and a contact sheet of all selected episodes. Every frame
//! shows the labelled images of all cameras side by side, depth and segmentation in colour, above the action, the reward and
//! whether the goal is reached.

mod colours;
mod label;
mod layout;
mod sheet;
mod video;

pub use layout::in_colour;
pub use sheet::contact_sheet;
pub(crate) use video::VideoFile;
pub use video::{check_mp4, integer_scale, write_mp4, write_mp4_scaled};

use crate::dataset::{Reader, StepRange};
use layout::FrameLayout;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result, limits};
use swm_image::{check_png, write_png};

/// Settings of a preview.
#[derive(Clone, Debug)]
pub struct PreviewOptions {
    /// Number of episodes, which are spread evenly over the dataset.
    pub episodes: usize,
    /// The columns to show, which hold images, depth or segmentation; all of these if empty.
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
/// The width of a contact sheet that is not exceeded, if a frame is narrower.
const SHEET_WIDTH: usize = 2000;

/// Number of rows decoded at once, which limits the memory.
const ROWS: usize = 32;

/// Writes `episode_N.mp4` for each selected episode and one `contact_sheet.png` into a folder. Returns the paths. Calls
/// `progress` with the number of finished episodes.
///
/// # Errors
/// If the dataset has no images, lacks one of the columns or is damaged, the contact sheet would be too large, another
/// process writes to the folder, one of the files exists and was not written by this program, or the folder cannot be
/// written.
pub fn preview(
    reader: &dyn Reader,
    folder: &Path,
    options: &PreviewOptions,
    mut progress: impl FnMut(usize),
) -> Result<Vec<PathBuf>> {
    let layout = FrameLayout::new(reader, &options.columns)?;
    let chosen = spread_episodes(reader, options.episodes, "preview")?;
    limits::SHEET_BYTES.check(limits::product([chosen.len(), SHEET_COLUMNS, layout.width, layout.height, 3]))?;
    let video_of = |episode: usize| folder.join(format!("episode_{}.mp4", reader.episodes()[episode].index));
    let contact_sheet_path = folder.join("contact_sheet.png");
    // Two previews would take the half-written files of the other for files of the user.
    let _lock = Lock::folder(folder)?;
    // Before any work, so that a refusal leaves no part of a preview.
    chosen.iter().try_for_each(|&episode| check_mp4(&video_of(episode)))?;
    check_png(&contact_sheet_path)?;
    files::delete_temporary(folder, |name| {
        let path = folder.join(name);
        path == contact_sheet_path || chosen.iter().any(|&episode| path == video_of(episode))
    })?;
    let (mut written, mut sheet) = (vec![], vec![]);
    for (done, &episode) in chosen.iter().enumerate() {
        let index = reader.episodes()[episode].index;
        let path = video_of(episode);
        let length = reader.episodes()[episode].length;
        let last = length - 1;
        let mut video = VideoFile::begin(&path, layout.width, layout.height, options.fps, 1)?;
        let on_sheet: Vec<usize> = (0..SHEET_COLUMNS).map(|i| i * last / (SHEET_COLUMNS - 1)).collect();
        for start in (0..length).step_by(ROWS) {
            let rows = ROWS.min(length - start);
            let batch = reader.read(&layout.names(), &[StepRange::new(episode, start, rows)])?;
            for row in 0..rows {
                let image = layout.draw(&batch, row, &format!("episode {index} step {}", start + row))?;
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
    // Frames of several cameras are wide: an episode then takes several lines of the sheet.
    let mut fit = (0..=SHEET_COLUMNS.ilog2()).map(|halvings| SHEET_COLUMNS >> halvings);
    let columns = fit.find(|columns| columns * layout.width <= SHEET_WIDTH).unwrap_or(1);
    let image = contact_sheet(layout.width, layout.height, &sheet, columns, 1)?;
    write_png(&contact_sheet_path, image.width, image.height, &image.rgb)?;
    written.push(contact_sheet_path);
    Ok(written)
}

/// Returns the positions of `count` episodes with rows, spread evenly over the dataset; of all if it has fewer. `what` is the
/// command, for the error.
///
/// # Errors
/// When there is no such episode, or `count` is 0.
pub fn spread_episodes(reader: &dyn Reader, count: usize, what: &str) -> Result<Vec<usize>> {
    let all: Vec<usize> = (0..reader.episodes().len()).filter(|&i| reader.episodes()[i].length > 0).collect();
    let count = count.min(all.len());
    if count == 0 {
        return Err(Error::config(what, "there is no episode to show", "collect episodes, or request at least one"));
    }
    Ok((0..count).map(|i| all[i * all.len() / count]).collect())
}
