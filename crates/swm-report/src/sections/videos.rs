//! The videos of a group, embedded as data URIs: a row for each start, with the episode of every policy and the goal.

use crate::charts::episodes::VideoIds;
use crate::group::Group;
use crate::limits::{self, mebibytes};
use crate::text::{escape, outcome, shorten};
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
    /// The number of videos that are embedded or listed.
    shown: usize,
    /// The first poster of the page: a frame of the task.
    pub(crate) task: Option<Poster>,
}

/// The videos of a group.
#[derive(Default)]
pub(crate) struct Gallery<'a> {
    /// The elements of the page; empty without videos.
    pub(crate) html: String,
    /// The ids of the embedded videos.
    pub(crate) ids: VideoIds<'a>,
}

/// The first frame of a video: the agent on the left, the goal on the right.
#[derive(Clone)]
pub(crate) struct Poster {
    /// The image as a data URI.
    pub(crate) uri: String,
    /// The `[width, height]` of the agent's frame, in pixels.
    pub(crate) size: [u32; 2],
}

/// A video of an episode.
struct Video<'a> {
    file: usize,
    run: &'a Run,
    name: &'a str,
    class: String,
    /// The folder of the results file.
    folder: &'a Path,
    /// The path in the results file.
    path: &'a str,
    /// The index of the episode, if the name has one.
    episode: Option<usize>,
}

/// Why a video is not embedded.
enum Absent {
    /// The page has enough videos.
    OverBudget,
    /// The file cannot be embedded, in words.
    Unusable(String),
    /// The page has it already, with this number.
    Twice(usize),
}

/// The index of an episode, if the names of its videos have one, and its seed.
type Start = (Option<usize>, u64);

impl Videos {
    /// Embeds the videos of all runs of a group, start by start.
    pub(crate) fn gallery<'a>(&mut self, group: &Group<'a>, results: &'a [(PathBuf, Results)]) -> Gallery<'a> {
        let mut gallery = Gallery::default();
        let (mut rows, mut absent, mut left_out) = (String::new(), String::new(), 0);
        for condition in &group.conditions {
            let mut heading = format!("<h4>{}</h4>\n", escape(&shorten(condition.name, limits::TEXT_CHARS)));
            for ((episode, _), videos) in starts(condition.rows.iter().map(|row| (row, results))) {
                let (mut cells, mut goal) = (String::new(), None);
                for video in videos {
                    match self.video(&video, &mut goal) {
                        Ok((number, cell)) => {
                            cells += &cell;
                            if let Some(episode) = video.episode {
                                let key = (video.file, &*video.run.condition, &*video.run.policy, episode);
                                gallery.ids.entry(key).or_insert_with(|| format!("video-{number}"));
                            }
                        }
                        Err(Absent::OverBudget) => left_out += 1,
                        Err(reason) => absent += &listed(&video, &reason),
                    }
                }
                if !cells.is_empty() {
                    let label = episode.map_or("Other videos".to_owned(), |episode| format!("Start {episode}"));
                    let goal = goal.as_ref().map_or(String::new(), goal_cell);
                    let _ = write!(
                        rows,
                        "{heading}<div class=\"start\">\n<p>{label}</p>\n<div class=\"cells\">\n{cells}{goal}</div>\n</div>\n"
                    );
                    heading.clear();
                }
            }
        }
        if left_out > 0 {
            let (count, size) = (limits::VIDEOS, mebibytes(limits::ALL_VIDEOS_BYTES));
            let _ = writeln!(
                absent,
                "<p class=\"note\">{left_out} more videos are left out, because a page holds at most {count} videos and \
                 {size} of video files.</p>"
            );
        }
        if !rows.is_empty() || !absent.is_empty() {
            let note = "A row for each start, with the episode of every policy and, if it was recorded, the goal.";
            gallery.html = format!("<h3>Videos</h3>\n<p class=\"note\">{note}</p>\n{rows}{absent}");
        }
        gallery
    }

    /// Embeds a video; returns its number and its figure. `goal` receives the poster of the first video that has one.
    fn video(&mut self, video: &Video<'_>, goal: &mut Option<Poster>) -> Result<(usize, String), Absent> {
        if self.shown == limits::VIDEOS {
            return Err(Absent::OverBudget);
        }
        let embedded = self.embed(video.folder, video.path);
        if !matches!(embedded, Err(Absent::OverBudget)) {
            self.shown += 1;
        }
        let (number, uri) = embedded?;
        let poster = self.poster(video);
        let name = escape(&shorten(&format!("{}, {}", video.name, video.run.condition), limits::TEXT_CHARS));
        let mut html =
            format!("<figure id=\"video-{number}\">\n<video controls=\"controls\" loop=\"loop\" muted=\"muted\" ");
        let _ = match &poster {
            // The video has the goal on its right half, which the last cell of the row shows.
            Some(Poster { uri, size: [width, height] }) => write!(
                html,
                "class=\"agent\" style=\"aspect-ratio: {width} / {height}\" preload=\"metadata\" poster=\"{uri}\" \
                 aria-label=\"{name}\""
            ),
            None => write!(html, "preload=\"metadata\" aria-label=\"{name}: agent on the left, goal on the right\""),
        };
        let _ = write!(
            html,
            " playsinline=\"playsinline\" src=\"{uri}\"></video>\n<figcaption><span class=\"swatch {}\"></span>\
             <b>{}</b>{}</figcaption>\n</figure>\n",
            video.class,
            escape(&shorten(video.name, limits::TEXT_CHARS)),
            caption(video)
        );
        if goal.is_none() {
            goal.clone_from(&poster);
        }
        if self.task.is_none() {
            self.task = poster;
        }
        Ok((number, html))
    }

    /// Embeds a file; returns its number and its data URI.
    fn embed(&mut self, folder: &Path, video: &str) -> Result<(usize, String), Absent> {
        let kind = match Path::new(video).extension().and_then(|extension| extension.to_str()) {
            Some("mp4") => "video/mp4",
            Some("webm") => "video/webm",
            _ => return Err(Absent::Unusable("is neither MP4 nor WebM".to_owned())),
        };
        let path = locate(folder, Path::new(video)).map_err(Absent::Unusable)?;
        if let Some(number) = self.embedded.get(&path) {
            return Err(Absent::Twice(*number));
        }
        let bytes = self.read(&path, limits::VIDEO_BYTES)?;
        let number = self.embedded.len() + 1;
        self.embedded.insert(path, number);
        Ok((number, data_uri(kind, &bytes)))
    }

    /// Reads a file that is embedded.
    fn read(&mut self, path: &Path, most: u64) -> Result<Vec<u8>, Absent> {
        let size = std::fs::metadata(path).map_err(|error| Absent::Unusable(error.to_string()))?.len();
        if size > most {
            return Err(Absent::Unusable(format!("has {}, more than the page embeds", mebibytes(size))));
        }
        if self.bytes + size > limits::ALL_VIDEOS_BYTES {
            return Err(Absent::OverBudget);
        }
        let unusable = |_| Absent::Unusable("cannot be read, or is not a regular file".to_owned());
        let bytes = files::read(path, most).map_err(unusable)?;
        self.bytes += bytes.len() as u64;
        Ok(bytes)
    }

    /// The poster of a video: the image of the same name beside it. `None` if there is none that can be embedded.
    fn poster(&mut self, video: &Video<'_>) -> Option<Poster> {
        let path = locate(video.folder, &Path::new(video.path).with_extension("png")).ok()?;
        let bytes = self.read(&path, limits::POSTER_BYTES).ok()?;
        // The header of a PNG file begins with its width and height.
        let sides = bytes.strip_prefix(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")?.first_chunk::<8>()?;
        let [width, height] =
            [0, 4].map(|at| u32::from_be_bytes([sides[at], sides[at + 1], sides[at + 2], sides[at + 3]]));
        let is_pair = width.is_multiple_of(2) && (2..=8192).contains(&width) && (1..=4096).contains(&height);
        is_pair.then(|| Poster { uri: data_uri("image/png", &bytes), size: [width / 2, height] })
    }
}

/// The videos of the runs of a condition, by start.
fn starts<'g, 'a: 'g>(
    rows: impl Iterator<Item = (&'g crate::group::Row<'a>, &'a [(PathBuf, Results)])>,
) -> Vec<(Start, Vec<Video<'a>>)> {
    let mut starts: BTreeMap<Start, Vec<Video<'a>>> = BTreeMap::new();
    for (row, results) in rows {
        let folder = results[row.file].0.parent().filter(|folder| *folder != Path::new(""));
        for path in &row.run.videos {
            let episode = episode_of(row.run, path);
            let video = Video {
                file: row.file,
                run: row.run,
                name: &row.run.policy,
                class: row.ink.class(),
                folder: folder.unwrap_or_else(|| Path::new(".")),
                path,
                episode,
            };
            let seed = episode.map_or(0, |episode| row.run.episodes[episode].seed);
            starts.entry((episode, seed)).or_default().push(video);
        }
    }
    starts.into_iter().collect()
}

/// The index of the episode of a video, with which its name ends: `in-distribution/lewm-003.mp4`.
fn episode_of(run: &Run, video: &str) -> Option<usize> {
    let stem = Path::new(video).file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
    let digits = stem.len() - stem.chars().rev().take_while(char::is_ascii_digit).count();
    stem[digits..].parse().ok().filter(|index| *index < run.episodes.len())
}

/// Describes the episode of a video.
fn caption(video: &Video<'_>) -> String {
    let Some(episode) = video.episode.and_then(|index| video.run.episodes.get(index)) else { return String::new() };
    let (class, outcome) = outcome(episode);
    format!("<br/><span class=\"mark {class}\">{outcome}</span>")
}

/// The goal of a start.
fn goal_cell(Poster { uri, size: [width, height] }: &Poster) -> String {
    format!(
        "<figure>\n<img class=\"goal\" style=\"aspect-ratio: {width} / {height}\" alt=\"The goal\" src=\"{uri}\"/>\n\
         <figcaption><b>Goal</b></figcaption>\n</figure>\n"
    )
}

/// A video that is not embedded, with the reason.
fn listed(video: &Video<'_>, reason: &Absent) -> String {
    let episode = video.episode.map_or(String::new(), |index| format!(", episode {index}"));
    let what = escape(&shorten(&format!("{}, {}{episode}", video.name, video.run.condition), limits::TEXT_CHARS));
    let path = escape(&shorten(video.path, limits::TEXT_CHARS));
    let why = match reason {
        Absent::Twice(number) => format!("The same file as <a href=\"#video-{number}\">video {number}</a>."),
        Absent::Unusable(reason) => format!("Not embedded: <code>{path}</code> {}.", escape(reason)),
        Absent::OverBudget => String::new(),
    };
    format!("<p class=\"note absent\">{what}. {why}</p>\n")
}

/// Returns the canonical path of a file in the folder of a results file.
///
/// # Errors
/// When it does not exist, or is outside that folder. A results file from a stranger could otherwise add any file of the
/// reader to a page that is then shared.
fn locate(folder: &Path, file: &Path) -> Result<PathBuf, String> {
    let missing = |_| "was not found in the folder of its results file".to_owned();
    let folder = folder.canonicalize().map_err(missing)?;
    let path = folder.join(file).canonicalize().map_err(missing)?;
    let is_inside = path.starts_with(&folder);
    if is_inside { Ok(path) } else { Err("is outside the folder of its results file".to_owned()) }
}

fn data_uri(kind: &str, bytes: &[u8]) -> String {
    format!("data:{kind};base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes))
}
