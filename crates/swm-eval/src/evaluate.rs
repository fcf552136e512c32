//! Evaluating: how often a policy reaches the goal from given starts, and how long it takes.
//!
//! The counting is strict. A start that already satisfies the goal is found right after the reset, is not played,
//! and is counted apart from the success rate, which comes with its 95 % Wilson interval. An episode succeeds
//! at the first step whose observation satisfies the goal, or that terminates, within the budget.
//!
//! A factor-shifted evaluation is the same with starts whose variation request samples or pins factors.

use crate::Starts;
use crate::world::{Control, Places, Play, Progress, World};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::results::{EpisodeResult, Proportion, Run, Summary, Timing};
use swm_core::{Batch, EnvPool, Error, Key, Manifest, Policy, Result};

/// How to evaluate.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EvalConfig {
    /// Who acts: `random`, `expert`, or a checkpoint's name.
    pub policy: String,
    /// The condition: `in distribution`, or what is shifted.
    pub condition: String,
    /// Steps an episode may take; all the world allows for `None`.
    pub budget: Option<usize>,
    /// Videos of the first episodes, if wanted.
    #[serde(skip)]
    pub videos: Option<Videos>,
}

/// Videos of the first episodes: the agent on the left, its goal on the right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Videos {
    /// The folder of the results file; paths in results are relative to it.
    pub root: PathBuf,
    /// The file names' beginning, below `root`: `videos/random` gives `videos/random-0.mp4`.
    pub prefix: String,
    /// How many episodes.
    pub count: usize,
    /// Frames a second, one a step.
    pub fps: u32,
}

impl World {
    /// Where results of these starts come from. What does not change them (the number of environments and
    /// threads) is not in it.
    pub fn eval_manifest(&self, starts: &Starts, budget: Option<usize>) -> Manifest {
        let image = self.pool().image().map(|(height, width)| [height, width]);
        let what = json!({
            "env": self.spec().id,
            "protocol": starts.protocol(),
            "episodes": starts.len(),
            "budget": budget.unwrap_or(self.pool().max_episode_steps()),
            "goal_offset": starts.goal_offset(),
            "variation": starts.variation(),
            "image": image,
        });
        let hashes = [("starts".to_owned(), starts.hash())].into();
        Manifest { hashes, ..Manifest::new("evaluate", starts.seed(), what) }
    }

    /// Plays every start once and judges it. Each slot takes the next start when it is free; what an episode
    /// brings depends on the start alone.
    ///
    /// # Errors
    /// When the budget exceeds what the world plays, videos are wanted of a world without pictures, the policy or an
    /// environment fails, or the run is stopped.
    pub fn evaluate(
        &mut self,
        policy: &mut dyn Policy,
        starts: &Starts,
        config: &EvalConfig,
        control: &mut Control<'_>,
    ) -> Result<Run> {
        let limit = self.pool().max_episode_steps();
        let budget = config.budget.unwrap_or(limit);
        if budget == 0 || budget > limit {
            return Err(Error::config(
                "evaluation budget",
                format!("{budget} steps in a world that truncates episodes after {limit}"),
                "choose at least 1 and at most that, or raise the world's max_episode_steps",
            ));
        }
        let videos =
            config.videos.as_ref().map(|videos| Filming::new(videos, self.pool(), starts.len())).transpose()?;
        let mut judging = Judging {
            starts,
            budget,
            places: Places::of(self.pool().infos().schema())?,
            next: 0,
            slots: vec![0; self.pool().len()],
            episodes: (0..starts.len()).map(|i| blank(starts, i)).collect(),
            done: 0,
            steps: 0,
            videos,
        };
        policy.take_latencies();
        let begun = Instant::now();
        self.play(policy, &mut judging, control)?;
        let wall_seconds = begun.elapsed().as_secs_f64();
        let Judging { episodes, videos, .. } = judging;
        let judged = || episodes.iter().filter(|episode| !episode.solved_at_start);
        let successes: Vec<f64> =
            judged().filter(|episode| episode.success).map(|episode| episode.steps as f64).collect();
        Ok(Run {
            condition: config.condition.clone(),
            policy: config.policy.clone(),
            solved_at_start: episodes.len() - judged().count(),
            success: Proportion::wilson(successes.len(), judged().count()),
            time_to_goal: Summary::of(&successes),
            timing: Timing { plan_seconds: Summary::of(&policy.take_latencies()), wall_seconds },
            videos: videos.map(Filming::write).unwrap_or_default(),
            episodes,
        })
    }
}

fn blank(starts: &Starts, episode: usize) -> EpisodeResult {
    EpisodeResult {
        seed: starts.reset_seed(episode),
        success: false,
        solved_at_start: false,
        steps: 0,
        total_reward: 0.0,
        start: starts.pick(episode),
    }
}

struct Judging<'a> {
    starts: &'a Starts,
    budget: usize,
    places: Places,
    next: usize,
    /// The episode each slot plays.
    slots: Vec<usize>,
    episodes: Vec<EpisodeResult>,
    done: usize,
    steps: usize,
    videos: Option<Filming>,
}

impl Judging<'_> {
    fn finished(&mut self, control: &mut Control<'_>) {
        self.done += 1;
        control.report(Progress { episodes: self.done, total: self.starts.len(), steps: self.steps });
    }

    fn film(&mut self, slot: usize, pool: &EnvPool) {
        if let Some(videos) = &mut self.videos {
            videos.frame(self.slots[slot], slot, pool);
        }
    }
}

impl Play for Judging<'_> {
    fn next(&mut self) -> Option<usize> {
        if !self.more() {
            return None;
        }
        self.next += 1;
        Some(self.next - 1)
    }

    fn more(&self) -> bool {
        self.next < self.starts.len()
    }

    fn key(&self, episode: usize) -> Key {
        self.starts.key(episode)
    }

    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        for &(slot, episode) in starting {
            self.slots[slot] = episode;
        }
        self.starts.start(pool, starting)
    }

    fn started(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        self.film(slot, pool);
        let solved = pool.infos().row(slot).at::<u8>(self.places.success)[0] != 0;
        self.episodes[self.slots[slot]].solved_at_start = solved;
        if solved {
            self.finished(control);
        }
        Ok(!solved)
    }

    fn acted(&mut self, _: usize, _: &EnvPool, _: &Batch) {}

    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        self.film(slot, pool);
        self.steps += 1;
        let row = pool.infos().row(slot);
        let flag = |place| row.at::<u8>(place)[0] != 0;
        let episode = &mut self.episodes[self.slots[slot]];
        episode.steps += 1;
        episode.total_reward += f64::from(row.at::<f32>(self.places.reward)[0]);
        episode.success = flag(self.places.success) || flag(self.places.terminated);
        let over = episode.success || flag(self.places.truncated) || episode.steps >= self.budget;
        if over {
            self.finished(control);
        }
        Ok(!over)
    }
}

/// The side small pictures are enlarged towards, in pixels.
const WATCHABLE: usize = 256;

/// Keeps the pictures of the first episodes and writes them as videos in the end.
struct Filming {
    videos: Videos,
    /// `(height, width)` of one picture.
    size: (usize, usize),
    /// Places of `pixels` and `goal` in the infos.
    places: [usize; 2],
    /// The frames of every filmed episode.
    frames: Vec<Vec<Vec<u8>>>,
}

impl Filming {
    fn new(videos: &Videos, pool: &EnvPool, episodes: usize) -> Result<Self> {
        let Some(size) = pool.image() else {
            return Err(Error::config(
                "videos",
                "the world draws no pictures",
                "give the world a picture size or ask for no videos",
            ));
        };
        let schema = pool.infos().schema();
        Ok(Self {
            videos: videos.clone(),
            size,
            places: [schema.index("pixels")?, schema.index("goal")?],
            frames: vec![vec![]; videos.count.min(episodes)],
        })
    }

    fn frame(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let Some(frames) = self.frames.get_mut(episode) else { return };
        let row = pool.infos().row(slot);
        let [agent, goal] = self.places.map(|place| row.at::<u8>(place));
        let line = self.size.1 * 3;
        let pairs = agent.chunks_exact(line).zip(goal.chunks_exact(line));
        frames.push(pairs.flat_map(|(agent, goal)| agent.iter().chain(goal).copied()).collect());
    }

    /// Writes the videos and returns their paths, relative to the root. A video that cannot be written (`ffmpeg`
    /// is missing, the disk is full) costs a warning: the figures stand without it.
    fn write(self) -> Vec<String> {
        let (height, width) = self.size;
        let scale = swm_data::integer_scale(width, height, WATCHABLE);
        let mut written = vec![];
        for (i, frames) in self.frames.iter().enumerate() {
            let name = format!("{}-{i}.mp4", self.videos.prefix);
            let path = self.videos.root.join(&name);
            let folder = path.parent().unwrap_or(Path::new("."));
            let made = std::fs::create_dir_all(folder)
                .map_err(|source| Error::io(folder, "creating the folder of videos", source))
                .and_then(|()| {
                    let frames = frames.iter().map(Vec::as_slice);
                    swm_data::write_mp4_scaled(&path, 2 * width, height, self.videos.fps, scale, frames)
                });
            match made {
                Ok(()) => written.push(name),
                Err(error) => {
                    tracing::warn!("{error}");
                    break;
                }
            }
        }
        written
    }
}
