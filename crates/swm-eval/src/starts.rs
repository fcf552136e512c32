//! [`Starts`]: the initial states and goals of an evaluation's episodes.
//!
//! Every policy of a comparison, the random-policy floor included, is evaluated on the same starts.

use crate::seeding::{episode_key, reset_seed};
use rand::Rng as _;
use std::collections::HashSet;
use swm_core::columns::{flat, flat_factor};
use swm_core::pool::Reset;
use swm_core::{
    Batch, Callable, ColumnSpec, DatasetStart, Env, EnvPool, Error, Key, ResetOptions, Result, Schema,
    VariationRequest, dataset_start, limits,
};
use swm_data::{Reader, StepRange};

/// Initial states and goals, which depend only on the request.
#[derive(Clone, Debug)]
pub struct Starts {
    seed: u64,
    n: usize,
    /// Whether the reset seeds are consecutive numbers instead of derived from keys.
    sequential: bool,
    variation: VariationRequest,
    dataset: Option<Rows>,
    /// The numbers of the episodes in the evaluation that the starts are taken from; `None` for all episodes.
    numbers: Option<Vec<usize>>,
}

/// Starts and goals from a dataset.
#[derive(Clone, Debug)]
struct Rows {
    /// `[episode, step]` of every start.
    picks: Vec<[usize; 2]>,
    goal_offset: usize,
    /// The start row and the goal row of every pick, alternating.
    rows: Batch,
    /// The methods that set the part of an environment's state that columns cannot restore.
    calls: Vec<Callable>,
}

impl Starts {
    /// The episodic protocol: `n` episodes, whose start and goal the environment draws from the episode's seed.
    /// `variation` samples or pins factors.
    ///
    /// # Errors
    /// When `n` is 0.
    pub fn episodic(n: usize, seed: u64, variation: VariationRequest) -> Result<Self> {
        check_count(n)?;
        Ok(Self { seed, n, sequential: false, variation, dataset: None, numbers: None })
    }

    /// The episodic protocol as the Python package `stable-worldmodel` 0.1.1 seeds it: episode `i` resets with
    /// `seed + i`.
    ///
    /// # Errors
    /// As [`Starts::episodic`].
    pub fn sequential(n: usize, seed: u64, variation: VariationRequest) -> Result<Self> {
        Ok(Self { sequential: true, ..Self::episodic(n, seed, variation)? })
    }

    /// The dataset protocol (of DINO-WM and LeWM): each pick `[episode, step]` of a dataset is a start, and the
    /// observation `goal_offset` steps later in the same episode is its goal, which is therefore reachable.
    ///
    /// Factors have the values of the recorded episode, except the factors that `variation` samples or pins. Such a
    /// `variation` applies a shift to recorded starts.
    ///
    /// `env` is one of the environments to be played; `calls` are the methods that set the part of its state that
    /// columns cannot restore.
    ///
    /// # Errors
    /// When there is no pick, a pick or its goal lies outside its episode, the dataset lacks columns that the
    /// environment needs ([`dataset_start::required_columns`]), or `variation` names an unknown factor.
    pub fn from_dataset(
        reader: &dyn Reader,
        env: &dyn Env,
        picks: Vec<[usize; 2]>,
        goal_offset: usize,
        seed: u64,
        variation: VariationRequest,
        calls: &[Callable],
    ) -> Result<Self> {
        check_count(picks.len())?;
        limits::STEPS.check(goal_offset)?;
        let columns = unshifted(dataset_start::required_columns(env, reader.schema(), calls)?, env, &variation)?;
        let mut ranges = Vec::with_capacity(2 * picks.len());
        for &[episode, step] in &picks {
            let found = reader.episodes().get(episode).ok_or_else(|| no_episode(reader, episode))?;
            if step.saturating_add(goal_offset) >= found.length {
                return Err(Error::mismatch(
                    format!("choosing a start in episode {episode}"),
                    format!("step {step} with its goal {goal_offset} steps later"),
                    format!("both among its {} rows", found.length),
                ));
            }
            ranges.push(StepRange { episode, start: step, length: 1 });
            ranges.push(StepRange { episode, start: step + goal_offset, length: 1 });
        }
        let names: Vec<&str> = columns.iter().map(String::as_str).collect();
        let rows = renamed(reader.read(&names, &ranges)?)?;
        let n = picks.len();
        let dataset = Some(Rows { picks, goal_offset, rows, calls: calls.to_vec() });
        Ok(Self { dataset, ..Self::episodic(n, seed, variation)? })
    }

    /// The dataset protocol without the dataset: `rows` are those of [`Starts::rows`], two for each pick.
    ///
    /// # Errors
    /// When there is no pick, or the number of rows is not twice the number of picks.
    pub fn from_rows(
        rows: Batch,
        picks: Vec<[usize; 2]>,
        goal_offset: usize,
        seed: u64,
        variation: VariationRequest,
    ) -> Result<Self> {
        if rows.rows() != 2 * picks.len() {
            let given = format!("{} rows for {} starts", rows.rows(), picks.len());
            return Err(Error::mismatch(
                "starting at recorded rows",
                given,
                "a start row and a goal row for each start",
            ));
        }
        let n = picks.len();
        let dataset = Some(Rows { picks, goal_offset, rows, calls: vec![] });
        Ok(Self { dataset, ..Self::episodic(n, seed, variation)? })
    }

    /// The starts with these numbers. They keep the keys and the reset seeds that they have among all starts.
    ///
    /// # Errors
    /// When there is no number, or no start with a number.
    pub fn only(&self, numbers: &[usize]) -> Result<Self> {
        check_count(numbers.len())?;
        if let Some(number) = numbers.iter().find(|&&number| number >= self.n) {
            return Err(Error::mismatch("choosing starts", format!("number {number}"), format!("one of {}", self.n)));
        }
        let dataset = self.dataset.as_ref().map(|dataset| dataset.only(numbers)).transpose()?;
        Ok(Self { n: numbers.len(), dataset, ..self.clone() }
            .numbered(numbers.iter().map(|&i| self.number(i)).collect()))
    }

    /// These starts with the numbers, and therefore the keys and the reset seeds, of other episodes.
    #[must_use]
    pub(crate) fn numbered(self, numbers: Vec<usize>) -> Self {
        Self { numbers: Some(numbers), ..self }
    }

    /// The number of a start in the evaluation that it is taken from.
    fn number(&self, start: usize) -> usize {
        self.numbers.as_ref().map_or(start, |numbers| numbers[start])
    }

    /// Chooses `n` different starts of a dataset, uniformly among all starts whose goal lies in the same episode: `[n]`
    /// picks `[episode, step]`.
    ///
    /// # Errors
    /// When the dataset has fewer than `n` such starts.
    pub fn choose(reader: &dyn Reader, n: usize, goal_offset: usize, seed: u64) -> Result<Vec<[usize; 2]>> {
        let all: Vec<usize> = (0..reader.episodes().len()).collect();
        Self::choose_among(reader, &all, n, goal_offset, seed)
    }

    /// Chooses starts as [`Starts::choose`] does, but only in `episodes`, such as those of a held-out
    /// [`swm_data::Split`].
    ///
    /// # Errors
    /// When the episodes have fewer than `n` starts, or an episode does not exist.
    pub fn choose_among(
        reader: &dyn Reader,
        episodes: &[usize],
        n: usize,
        goal_offset: usize,
        seed: u64,
    ) -> Result<Vec<[usize; 2]>> {
        // Candidate starts are numbered episode by episode; `ends[e]` is one past the last number of the `e`-th
        // episode.
        let mut total = 0;
        let mut ends = Vec::with_capacity(episodes.len());
        for &episode in episodes {
            let found = reader.episodes().get(episode).ok_or_else(|| no_episode(reader, episode))?;
            total += found.length.saturating_sub(goal_offset);
            ends.push(total);
        }
        if n > total {
            return Err(Error::config(
                "number of evaluation starts",
                format!(
                    "{n}, but the dataset's {} episodes have {total} steps with a goal {goal_offset} steps later",
                    episodes.len()
                ),
                "choose fewer, lower the goal offset, or collect more episodes",
            ));
        }
        let mut rng = Key::new(seed).with("starts").rng();
        let mut taken = HashSet::new();
        let mut picks = Vec::with_capacity(n);
        while picks.len() < n {
            let number = rng.random_range(0..total as u64) as usize;
            if taken.insert(number) {
                let i = ends.partition_point(|&end| end <= number);
                let before = if i == 0 { 0 } else { ends[i - 1] };
                picks.push([episodes[i], number - before]);
            }
        }
        Ok(picks)
    }

    /// Chooses one start in each of `n` different episodes among `episodes`: the episodes uniformly, and in each a step
    /// uniformly among those whose goal lies in it. The picks of a smaller `n` are the first of these.
    ///
    /// Starts of one episode tend to end equally. Statistics that hold at any number of starts need independent outcomes, which those
    /// of different episodes are, if the episodes were recorded independently.
    ///
    /// # Errors
    /// When fewer than `n` episodes have a start, or an episode does not exist.
    pub fn choose_one_per_episode(
        reader: &dyn Reader,
        episodes: &[usize],
        n: usize,
        goal_offset: usize,
        seed: u64,
    ) -> Result<Vec<[usize; 2]>> {
        // The episodes with a start, each with the number of its starts.
        let mut left = Vec::with_capacity(episodes.len());
        for &episode in episodes {
            let found = reader.episodes().get(episode).ok_or_else(|| no_episode(reader, episode))?;
            let starts = found.length.saturating_sub(goal_offset);
            left.extend((starts > 0).then_some([episode, starts]));
        }
        if n > left.len() {
            return Err(Error::config(
                "number of evaluation starts",
                format!(
                    "{n}, each from an episode of its own, but {} of the dataset's {} episodes have a step with a goal \
                     {goal_offset} steps later",
                    left.len(),
                    episodes.len()
                ),
                format!("choose at most {}, lower the goal offset, or collect more episodes", left.len()),
            ));
        }
        let mut rng = Key::new(seed).with("starts, one per episode").rng();
        let mut draw = |count: usize| rng.random_range(0..count as u64) as usize;
        let mut picks = Vec::with_capacity(n);
        for i in 0..n {
            let drawn = i + draw(left.len() - i);
            left.swap(i, drawn);
            let [episode, starts] = left[i];
            picks.push([episode, draw(starts)]);
        }
        Ok(picks)
    }

    /// The number of starts.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Whether there are no starts, which is never the case.
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// The seed of the starts.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The factors that are sampled and pinned.
    pub fn variation(&self) -> &VariationRequest {
        &self.variation
    }

    /// The name of the protocol: `episodic` or `dataset`.
    pub fn protocol(&self) -> &'static str {
        if self.dataset.is_some() { "dataset" } else { "episodic" }
    }

    /// Steps between a start and its goal, for starts from a dataset.
    pub fn goal_offset(&self) -> Option<usize> {
        self.dataset.as_ref().map(|dataset| dataset.goal_offset)
    }

    /// The pick `[episode, step]` of a start, for starts from a dataset.
    pub fn pick(&self, episode: usize) -> Option<[usize; 2]> {
        self.dataset.as_ref().map(|dataset| dataset.picks[episode])
    }

    /// The start row and the goal row of every start, alternating, for starts from a dataset.
    pub fn rows(&self) -> Option<&Batch> {
        self.dataset.as_ref().map(|dataset| &dataset.rows)
    }

    pub(crate) fn key(&self, episode: usize) -> Key {
        episode_key(self.seed, self.number(episode))
    }

    pub(crate) fn reset_seed(&self, episode: usize) -> u64 {
        if self.sequential {
            // At most 63 bits, like all reset seeds.
            self.seed.wrapping_add(self.number(episode) as u64) & (u64::MAX >> 1)
        } else {
            reset_seed(self.key(episode))
        }
    }

    /// Starts episodes in slots of a pool: `(slot, episode)`.
    pub(crate) fn start(&self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        let options = ResetOptions { variation: self.variation.clone(), ..ResetOptions::default() };
        let resets: Vec<Reset> = starting
            .iter()
            .map(|&(slot, episode)| Reset { slot, seed: self.reset_seed(episode), options: options.clone() })
            .collect();
        let Some(dataset) = &self.dataset else { return pool.reset(&resets) };
        let slots: Vec<usize> = starting.iter().map(|&(slot, _)| slot).collect();
        pool.restart(&slots, |slot, env| {
            let Some(i) = slots.iter().position(|&started| started == slot) else { return Ok(()) };
            let episode = starting[i].1;
            let [start, goal] = [2 * episode, 2 * episode + 1].map(|row| dataset.rows.row(row));
            let from = DatasetStart { start, goal, callables: &dataset.calls };
            dataset_start::reset(env, resets[i].seed, &resets[i].options, from)
        })
    }
}

impl Rows {
    /// The rows of the picks with these indices.
    fn only(&self, indices: &[usize]) -> Result<Self> {
        let mut rows = Batch::zeros(self.rows.schema(), 0);
        for row in indices.iter().flat_map(|index| [2 * index, 2 * index + 1]) {
            rows.push_row(&self.rows, row)?;
        }
        let picks = indices.iter().map(|&index| self.picks[index]).collect();
        Ok(Self { picks, rows, calls: self.calls.clone(), ..*self })
    }
}

fn no_episode(reader: &dyn Reader, episode: usize) -> Error {
    let known = format!("one of the dataset's {} episodes, counted from 0", reader.episodes().len());
    Error::mismatch("choosing a start", format!("episode {episode}"), known)
}

fn check_count(n: usize) -> Result<()> {
    limits::EVALUATED_EPISODES.check(n)?;
    if n > 0 {
        return Ok(());
    }
    Err(Error::config("number of evaluation episodes", "0", "choose at least 1"))
}

/// Removes the columns of factors that are sampled or pinned.
fn unshifted(columns: Vec<String>, env: &dyn Env, variation: &VariationRequest) -> Result<Vec<String>> {
    let space = &env.spec().variation_space;
    let mut shifted = HashSet::new();
    for name in variation.variation.iter().flatten().chain(variation.variation_values.keys()) {
        for i in space.select(name)? {
            shifted.insert(flat_factor(&space.factors()[i].key));
        }
    }
    Ok(columns.into_iter().filter(|name| !shifted.contains(&flat(name))).collect())
}

/// Renames columns to their flat names, because environments expect flat names for every dataset format.
fn renamed(rows: Batch) -> Result<Batch> {
    let columns: Vec<ColumnSpec> =
        rows.schema().columns().iter().map(|c| ColumnSpec { name: flat(&c.name), ..c.clone() }).collect();
    let mut flat = Batch::zeros(&Schema::new(columns)?, rows.rows());
    for column in 0..rows.schema().columns().len() {
        flat.bytes_mut(column).copy_from_slice(rows.bytes(column));
    }
    Ok(flat)
}
