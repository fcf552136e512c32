//! [`frame_strip`]: frames of one episode side by side.

use crate::request::EvalRequest;
use crate::runner::{Episodes, Resolver, RunOptions};
use swm_core::run::Control;
use swm_core::{Error, Result, files};

/// The largest frame strip, in bytes.
const MAX_BYTES: u64 = 64 << 20;

/// Plays one episode of a request again, with its last policy, and returns `frames` of its frames at equal distances in time, from
/// the first to the last, with the goal behind them, as a PNG file. `None` without frames.
///
/// # Errors
/// As [`EvalRequest::run`], and when there is no such episode.
pub fn frame_strip(
    request: &EvalRequest,
    episode: usize,
    frames: usize,
    resolver: &dyn Resolver,
    options: &RunOptions,
    control: &mut Control<'_>,
) -> Result<Option<Vec<u8>>> {
    if request.image.is_none() {
        return Ok(None);
    }
    let folder = tempfile::tempdir().map_err(|source| Error::io(std::env::temp_dir(), "creating a folder", source))?;
    let videos = Some((folder.path().to_owned(), 1));
    let options = RunOptions { videos, frame_strip: Some(frames.max(2)), staged: false, ..options.clone() };
    let results = request.run_episodes(Episodes::Only(&[episode]), resolver, &options, control)?;
    let file = results.runs.last().and_then(|run| run.videos.first());
    file.map(|file| files::read(&folder.path().join(file), MAX_BYTES)).transpose()
}

/// Puts frames at equal distances in time side by side, and the goal behind them: `[height, (count + 1) * width, 3]`. Each row of
/// a frame has that of the agent, then that of the goal.
pub(crate) fn side_by_side(frames: &[Vec<u8>], (height, width): (usize, usize), count: usize) -> Vec<u8> {
    let line = 3 * width;
    let last = frames.len().saturating_sub(1);
    let chosen = (0..count).map(|i| i * last / (count - 1).max(1));
    let chosen: Vec<&Vec<u8>> = chosen.filter_map(|i| frames.get(i)).collect();
    let mut image = Vec::with_capacity((count + 1) * line * height);
    for row in 0..height {
        let start = 2 * line * row;
        for frame in &chosen {
            image.extend_from_slice(&frame[start..][..line]);
        }
        image.extend(frames.last().into_iter().flat_map(|frame| &frame[start + line..][..line]));
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_have_frames_from_the_first_to_the_last_and_the_goal() {
        // Frames of 2 x 1 pixels whose agent has the number of the step, and whose goal is 200.
        let frame = |step: u8| [[step; 3], [200; 3], [step; 3], [200; 3]].concat();
        let frames: Vec<Vec<u8>> = (0..9).map(frame).collect();
        let row = [[0_u8; 3], [4; 3], [8; 3], [200; 3]].concat();
        assert_eq!(side_by_side(&frames, (2, 1), 3), [row.clone(), row].concat());
        assert_eq!(side_by_side(&frames[..1], (2, 1), 2)[..9], [[0_u8; 3], [0; 3], [200; 3]].concat()[..]);
    }
}
