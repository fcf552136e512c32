//! The videos of a group, embedded as data URIs.

use crate::group::Group;
use crate::text::{escape, outcome};
use base64::Engine as _;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::Results;
use swm_core::results::Run;

/// The size of the largest video that is embedded, in bytes; base64 makes it a third larger.
const LARGEST: u64 = 8 << 20;

/// Writes the videos of all runs of a group.
pub(super) fn write(html: &mut String, group: &Group<'_>, results: &[(PathBuf, Results)]) {
    let folder = |file: usize| results[file].0.parent().unwrap_or_else(|| Path::new(""));
    let videos: String = group.rows().map(|row| figures(row.run, folder(row.file))).collect();
    if !videos.is_empty() {
        let _ = write!(
            html,
            "<h3>Videos</h3>\n<p class=\"note\">The agent on the left, the goal on the right.</p>\n\
             <div class=\"videos\">\n{videos}</div>\n"
        );
    }
}

/// Returns the videos of a run as figures; `folder` is the folder of the run's results file. If a video is missing, too
/// large or of an unknown format, the figure contains the name of the video and the reason.
fn figures(run: &Run, folder: &Path) -> String {
    let mut html = String::new();
    for video in &run.videos {
        let caption = caption(run, video);
        let name = escape(&format!("{}, {}", run.policy, run.condition));
        match embed(&folder.join(video)) {
            Ok(uri) => {
                let _ = write!(
                    html,
                    "<figure class=\"video\">\n<video controls=\"controls\" loop=\"loop\" muted=\"muted\" \
                     playsinline=\"playsinline\" preload=\"metadata\" aria-label=\"{name}: agent on the left, goal on \
                     the right\" src=\"{uri}\"></video>\n<figcaption><b>{name}</b>{caption}</figcaption>\n</figure>\n"
                );
            }
            Err(reason) => {
                let _ = write!(
                    html,
                    "<figure class=\"video absent\">\n<p>Not embedded: <code>{}</code> {reason}.</p>\n\
                     <figcaption><b>{name}</b>{caption}</figcaption>\n</figure>\n",
                    escape(video)
                );
            }
        }
    }
    html
}

fn embed(path: &Path) -> Result<String, String> {
    let kind = match path.extension().and_then(|extension| extension.to_str()) {
        Some("mp4") => "video/mp4",
        Some("webm") => "video/webm",
        _ => return Err("is neither MP4 nor WebM".to_owned()),
    };
    let size = std::fs::metadata(path).map_err(|_| "was not found in the folder of its results file".to_owned())?.len();
    if size > LARGEST {
        return Err(format!("has {:.1} MiB, more than the page embeds", size as f64 / f64::from(1 << 20)));
    }
    let bytes = std::fs::read(path).map_err(|error| format!("cannot be read ({})", escape(&error.to_string())))?;
    Ok(format!("data:{kind};base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes)))
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
