//! The videos of a group, embedded as data URIs.

use crate::group::Group;
use crate::limits::{self, mebibytes};
use crate::text::{escape, outcome};
use base64::Engine as _;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::results::Run;
use swm_core::{Results, files};

/// The videos of a page: every file is embedded once, up to a common size.
#[derive(Default)]
pub(crate) struct Videos {
    /// The numbers of the embedded files, by canonical path.
    embedded: BTreeMap<PathBuf, usize>,
    /// The size of the embedded files, in bytes.
    bytes: u64,
    /// The number of figures.
    figures: usize,
}

/// Why a video has no figure with its frames.
enum Absent {
    /// The page has enough videos.
    OverBudget,
    /// The file cannot be embedded, in words.
    Unusable(String),
}

impl Videos {
    /// Writes the videos of all runs of a group.
    pub(super) fn write(&mut self, html: &mut String, group: &Group<'_>, results: &[(PathBuf, Results)]) {
        let (mut figures, mut left_out) = (String::new(), 0);
        for row in group.rows() {
            let file = &results[row.file].0;
            let folder = file.parent().filter(|folder| *folder != Path::new("")).unwrap_or_else(|| Path::new("."));
            for video in &row.run.videos {
                left_out += usize::from(!self.figure(&mut figures, row.run, folder, video));
            }
        }
        if figures.is_empty() && left_out == 0 {
            return;
        }
        let _ = write!(
            html,
            "<h3>Videos</h3>\n<p class=\"note\">The agent on the left, the goal on the right.</p>\n\
             <div class=\"videos\">\n{figures}</div>\n"
        );
        if left_out > 0 {
            let (count, size) = (limits::VIDEOS, mebibytes(limits::ALL_VIDEOS_BYTES));
            let _ = writeln!(
                html,
                "<p class=\"note\">{left_out} more videos are left out, because a page holds at most {count} videos and \
                 {size} of video files.</p>"
            );
        }
    }

    /// Writes a figure with a video or with the reason why it is absent; returns whether the page had room for it.
    /// `folder` is the folder of the results file.
    fn figure(&mut self, html: &mut String, run: &Run, folder: &Path, video: &str) -> bool {
        if self.figures == limits::VIDEOS {
            return false;
        }
        let caption = caption(run, video);
        let name = escape(&format!("{}, {}", run.policy, run.condition));
        let content = match self.content(folder, video, &name) {
            Ok(content) => content,
            Err(Absent::OverBudget) => return false,
            Err(Absent::Unusable(reason)) => format!(
                "<figure class=\"video absent\">\n<p>Not embedded: <code>{}</code> {}.</p>\n",
                escape(video),
                escape(&reason)
            ),
        };
        self.figures += 1;
        let _ = write!(html, "{content}<figcaption><b>{name}</b>{caption}</figcaption>\n</figure>\n");
        true
    }

    /// Returns the start of a figure: the video, or a link to the figure that has it already.
    fn content(&mut self, folder: &Path, video: &str, name: &str) -> Result<String, Absent> {
        let (path, kind) = locate(folder, video).map_err(Absent::Unusable)?;
        if let Some(number) = self.embedded.get(&path) {
            return Ok(format!(
                "<figure class=\"video absent\">\n<p>The same file as <a href=\"#video-{number}\">video {number}</a>.</p>\n"
            ));
        }
        let size = std::fs::metadata(&path).map_err(|error| Absent::Unusable(error.to_string()))?.len();
        if size > limits::VIDEO_BYTES {
            return Err(Absent::Unusable(format!("has {}, more than the page embeds", mebibytes(size))));
        }
        if self.bytes + size > limits::ALL_VIDEOS_BYTES {
            return Err(Absent::OverBudget);
        }
        let bytes = files::read(&path, limits::VIDEO_BYTES)
            .map_err(|_| Absent::Unusable("cannot be read, or is not a regular file".to_owned()))?;
        self.bytes += bytes.len() as u64;
        let number = self.embedded.len() + 1;
        self.embedded.insert(path, number);
        Ok(format!(
            "<figure class=\"video\" id=\"video-{number}\">\n<video controls=\"controls\" loop=\"loop\" muted=\"muted\" \
             playsinline=\"playsinline\" preload=\"metadata\" aria-label=\"{name}: agent on the left, goal on the right\" \
             src=\"data:{kind};base64,{}\"></video>\n",
            base64::engine::general_purpose::STANDARD.encode(bytes)
        ))
    }
}

/// Returns the canonical path of a video and its media type.
///
/// # Errors
/// When it is neither MP4 nor WebM, does not exist, or is outside the folder of the results file. A results file from a
/// stranger could otherwise add any file of the reader to a page that is then shared.
fn locate(folder: &Path, video: &str) -> Result<(PathBuf, &'static str), String> {
    let kind = match Path::new(video).extension().and_then(|extension| extension.to_str()) {
        Some("mp4") => "video/mp4",
        Some("webm") => "video/webm",
        _ => return Err("is neither MP4 nor WebM".to_owned()),
    };
    let missing = |_| "was not found in the folder of its results file".to_owned();
    let folder = folder.canonicalize().map_err(missing)?;
    let path = folder.join(video).canonicalize().map_err(missing)?;
    if path.starts_with(&folder) {
        Ok((path, kind))
    } else {
        Err("is outside the folder of its results file".to_owned())
    }
}

/// Describes the episode of a video. The name of the video ends in the index of the episode:
/// `in-distribution/lewm-003.mp4`.
fn caption(run: &Run, video: &str) -> String {
    let stem = Path::new(video).file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
    let digits = stem.len() - stem.chars().rev().take_while(char::is_ascii_digit).count();
    let Ok(index) = stem[digits..].parse::<usize>() else { return String::new() };
    let Some(episode) = run.episodes.get(index) else { return String::new() };
    let (class, outcome) = outcome(episode);
    format!("<br/>episode {index} <span class=\"mark {class}\">{outcome}</span>")
}
