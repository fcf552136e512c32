//! [`Starts`]: from where episodes are played and towards which goal. Every policy of a comparison, the random
//! floor included, is given the same starts.

use crate::world::{episode_key, reset, reset_seed};
use rand::Rng as _;
use std::collections::HashSet;
use swm_core::{Batch, ColumnSpec, EnvPool, EnvSpec, Error, Key, Result, Schema, VariationRequest, manifest};
use swm_data::{Reader, StepRange};

/// Starts and goals, decided by what was asked and nothing else.
#[derive(Clone, Debug)]
pub struct Starts {
    seed: u64,
    n: usize,
    variation: VariationRequest,
    dataset: Option<Rows>,
}

/// Starts and goals out of a dataset.
#[derive(Clone, Debug)]
struct Rows {
    /// `[episode, step]` of every start.
    picks: Vec<[usize; 2]>,
    goal_offset: usize,
    /// The start and the goal of every pick, one after the other.
    rows: Batch,
}

impl Starts {
    /// The episodic protocol: `n` episodes, start and goal chosen by the environment from the episode's seed.
    /// Factors named in `variation` are sampled or pinned as it says.
    ///
    /// # Errors
    /// When there is no episode.
    pub fn episodic(n: usize, seed: u64, variation: VariationRequest) -> Result<Self> {
        check_count(n)?;
        Ok(Self { seed, n, variation, dataset: None })
    }

    /// The dataset-driven protocol (as of DINO-WM and LeWM): each pick `[episode, step]` of a dataset is a start,
    /// and what the same episode showed `goal_offset` steps later is its goal, so it is reachable.
    ///
    /// Factors are those of the recorded episode, except the ones `variation` names: these are sampled or
    /// pinned as it says, which is how a shift is applied to recorded starts.
    ///
    /// # Errors
    /// When there is no pick, a pick or its goal lies outside its episode, the dataset has no `state` column of this
    /// environment's shape, or `variation` names what is no factor.
    pub fn from_dataset(
        reader: &dyn Reader,
        spec: &EnvSpec,
        picks: Vec<[usize; 2]>,
        goal_offset: usize,
        seed: u64,
        variation: VariationRequest,
    ) -> Result<Self> {
        check_count(picks.len())?;
        let columns = restored_columns(reader.schema(), spec, &variation)?;
        let mut ranges = Vec::with_capacity(2 * picks.len());
        for &[episode, step] in &picks {
            let Some(found) = reader.episodes().get(episode) else {
                let given = format!("episode {episode}");
                return Err(Error::mismatch(
                    "choosing a start",
                    given,
                    format!("0 ..= {}", reader.episodes().len() - 1),
                ));
            };
            if step + goal_offset >= found.length {
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
        Ok(Self { seed, n: picks.len(), variation, dataset: Some(Rows { picks, goal_offset, rows }) })
    }

    /// Chooses `n` different starts of a dataset, uniformly among all whose goal lies in the same episode.
    ///
    /// # Errors
    /// When there are fewer than `n` of them.
    pub fn choose(reader: &dyn Reader, n: usize, goal_offset: usize, seed: u64) -> Result<Vec<[usize; 2]>> {
        // Starts are numbered episode after episode; `ends[e]` is the number after the last of episode `e`.
        let mut total = 0;
        let ends: Vec<usize> = reader
            .episodes()
            .iter()
            .map(|episode| {
                total += episode.length.saturating_sub(goal_offset);
                total
            })
            .collect();
        if n > total {
            return Err(Error::config(
                "number of evaluation starts",
                format!("{n}, but the dataset has {total} steps with another {goal_offset} steps behind them"),
                "ask for fewer, lower the goal offset, or collect more episodes",
            ));
        }
        let mut rng = Key::new(seed).with("starts").rng();
        let mut taken = HashSet::new();
        let mut picks = Vec::with_capacity(n);
        while picks.len() < n {
            let number = rng.random_range(0..total as u64) as usize;
            if taken.insert(number) {
                let episode = ends.partition_point(|&end| end <= number);
                let before = if episode == 0 { 0 } else { ends[episode - 1] };
                picks.push([episode, number - before]);
            }
        }
        Ok(picks)
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Whether there is none (never).
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// The seed behind them.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Factors sampled and pinned.
    pub fn variation(&self) -> &VariationRequest {
        &self.variation
    }

    /// The protocol's name: `episodic` or `dataset`.
    pub fn protocol(&self) -> &'static str {
        if self.dataset.is_some() { "dataset" } else { "episodic" }
    }

    /// Steps between a start and its goal, where they come from a dataset.
    pub fn goal_offset(&self) -> Option<usize> {
        self.dataset.as_ref().map(|dataset| dataset.goal_offset)
    }

    /// `[episode, step]` of a start, where they come from a dataset.
    pub fn pick(&self, episode: usize) -> Option<[usize; 2]> {
        self.dataset.as_ref().map(|dataset| dataset.picks[episode])
    }

    /// A BLAKE3 hash of what the starts are made of, for a manifest: the reset seeds, and which rows of the dataset
    /// were picked and what they hold, if any. The rest of a dataset decides nothing here.
    pub fn hash(&self) -> String {
        let mut bytes: Vec<u8> = (0..self.n).flat_map(|i| self.reset_seed(i).to_le_bytes()).collect();
        if let Some(Rows { picks, goal_offset, rows }) = &self.dataset {
            let numbers = picks.iter().flatten().chain([goal_offset]);
            bytes.extend(numbers.flat_map(|&number| (number as u64).to_le_bytes()));
            for (i, column) in rows.schema().columns().iter().enumerate() {
                bytes.extend_from_slice(column.name.as_bytes());
                bytes.extend_from_slice(rows.bytes(i));
            }
        }
        manifest::hash(&bytes)
    }

    pub(crate) fn key(&self, episode: usize) -> Key {
        episode_key(self.seed, episode)
    }

    pub(crate) fn reset_seed(&self, episode: usize) -> u64 {
        reset_seed(self.key(episode))
    }

    /// Starts episodes in slots of a pool: `(slot, episode)`.
    pub(crate) fn start(&self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        let resets: Vec<_> =
            starting.iter().map(|&(slot, episode)| reset(slot, self.key(episode), &self.variation)).collect();
        let Some(dataset) = &self.dataset else { return pool.reset(&resets) };
        let slots: Vec<usize> = starting.iter().map(|&(slot, _)| slot).collect();
        pool.restart(&slots, |slot, env| {
            let Some(i) = slots.iter().position(|&started| started == slot) else { return Ok(()) };
            // The reset decides what the rows do not: randomness, and factors that are shifted or not recorded.
            env.reset(resets[i].seed, &resets[i].options)?;
            let episode = starting[i].1;
            env.restore_from(dataset.rows.row(2 * episode), dataset.rows.row(2 * episode + 1))
        })
    }
}

fn check_count(n: usize) -> Result<()> {
    if n > 0 {
        return Ok(());
    }
    Err(Error::config("number of evaluation episodes", "0", "ask for at least 1"))
}

/// The columns an environment is restored from: all but pictures, and but the factors that are to be shifted.
fn restored_columns(stored: &Schema, spec: &EnvSpec, variation: &VariationRequest) -> Result<Vec<String>> {
    let state = stored.column("state")?;
    if let Some(own) = spec.columns.iter().find(|column| column.name == "state")
        && own.shape != state.shape
    {
        return Err(Error::mismatch(
            format!("starting {} from a dataset", spec.id),
            format!("states of shape {:?}", state.shape),
            format!("{:?}; was the dataset collected in this environment?", own.shape),
        ));
    }
    let factors = spec.variation_space.factors();
    let mut shifted = HashSet::new();
    for name in variation.variation.iter().flatten().chain(variation.variation_values.keys()) {
        for i in spec.variation_space.select(name)? {
            shifted.insert(flat(&format!("variation.{}", factors[i].key)));
        }
    }
    let kept = stored.columns().iter().filter(|column| !column.is_image() && !shifted.contains(&flat(&column.name)));
    Ok(kept.map(|column| column.name.clone()).collect())
}

/// A column's name as formats without dots store it, and as environments look for it.
fn flat(name: &str) -> String {
    name.replace('.', "_")
}

/// The same rows under flat names, so that environments find factors whatever format they come from.
fn renamed(rows: Batch) -> Result<Batch> {
    let columns: Vec<ColumnSpec> =
        rows.schema().columns().iter().map(|c| ColumnSpec { name: flat(&c.name), ..c.clone() }).collect();
    let mut flat = Batch::zeros(&Schema::new(columns)?, rows.rows());
    for column in 0..rows.schema().columns().len() {
        flat.bytes_mut(column).copy_from_slice(rows.bytes(column));
    }
    Ok(flat)
}
