//! [`verify`]: plays the episodes of an entry, or a random share of them, and lists what differs.

use super::Entry;
use crate::capsule::{computes_alike, cpu_level};
use crate::resolver::HomeResolver;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use swm_core::results::{EpisodeResult, Run};
use swm_core::run::Control;
use swm_core::{Env, Error, Key, Origin, Result, Results};
use swm_data::Reader;
use swm_eval::reproduce::{Difference, Kind};
use swm_eval::{
    EvalRequest, PolicyRequest, Predictor, ResolvedPolicy, Resolver, RunOptions, World, reproduce_episodes,
};
use swm_models::{Device, device};

/// The share of the played episodes of a run that may end differently on another kind of processor or device, rounded down:
/// none of fewer than 20.
pub const TOLERANCE: f64 = 0.05;
/// By how much of the larger one two sums of rewards may differ, if an episode does not end differently.
pub const REWARD_TOLERANCE: f64 = 0.01;
/// By how much two sums of rewards may differ that are almost zero.
const SMALLEST_REWARD: f64 = 1e-6;

/// How an entry is verified.
#[derive(Clone, Debug, Default)]
pub struct How {
    /// The share of the episodes to play, above 0 and at most 1.
    pub share: f64,
    /// The seed that chooses them.
    pub seed: u64,
    /// Whether another kind of processor or another device is refused instead of verified with [`TOLERANCE`].
    pub exact: bool,
    /// Whether the entry may choose any environment, wrapper and dataset.
    pub trust: bool,
    /// The environment, if the user names it.
    pub env: Option<String>,
    /// The checkpoint, in place of the one that the entry names.
    pub checkpoint: Option<String>,
    /// The dataset, in place of the one that the entry names.
    pub dataset: Option<String>,
}

/// What must be equal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Class {
    /// Every bit of every played episode: the device and the processor, or its level of vector instructions, are those of the
    /// entry.
    Exact,
    /// The seeds and dataset rows of all episodes, all starts and goals, and the end of all but [`TOLERANCE`] of the played episodes:
    /// success, steps, and the sum of rewards up to [`REWARD_TOLERANCE`]. The last bits of a model differ between processors.
    Outcomes,
}

/// The result of verifying an entry.
#[derive(Clone, Debug, Serialize)]
pub struct Verification {
    /// The hash of the entry.
    pub hash: String,
    /// The hash of the weights.
    pub weights: String,
    /// What had to be equal.
    pub class: Class,
    /// The processor that the results were made on.
    pub made_on: String,
    /// This processor.
    pub verified_on: String,
    /// The numbers of the episodes that were played, by every policy under every condition.
    pub played: Vec<usize>,
    /// The number of episodes of each run.
    pub episodes: usize,
    /// The number of runs: policies under conditions.
    pub runs: usize,
    /// Differences that the class allows.
    pub remarks: Vec<String>,
    /// Differences that it does not allow.
    pub faults: Vec<String>,
}

/// Plays episodes of the entry in a file again. Names in the entry are chosen by the file, unless the user trusts it.
///
/// # Errors
/// When the entry is damaged or of another version of the program, its checkpoint or dataset is not found or has another
/// hash, or it names something that a file may not choose.
pub fn verify(path: &Path, how: &How, options: &RunOptions, control: &mut Control<'_>) -> Result<Verification> {
    let entry = Entry::read(path)?;
    let (theirs, ours) = (&entry.results.manifest.swm_version, env!("CARGO_PKG_VERSION"));
    if theirs != ours {
        let problem = format!("was made with stable-worldmodel {theirs}, and this is {ours}");
        return Err(Error::config(path.display().to_string(), problem, "verify it with the version that made it"));
    }
    let same_processor = computes_alike(&entry.processor, &cpu_level());
    if how.exact && !same_processor {
        let problem = format!("was made on {}, and this is {}", entry.processor, cpu_level());
        return Err(Error::config(path.display().to_string(), problem, "verify it on such a processor"));
    }
    let request = entry.request()?;
    let resolver = resolver(path, &entry, how)?;
    if how.exact {
        check_device(path, &entry, &resolver.home)?;
    }
    let played = numbers(request.episodes, how);
    let again = reproduce_episodes(&entry.results, &played, &resolver, options, control)?;
    let same_device = entry.results.manifest.device == again.results.manifest.device;
    let class = if same_processor && same_device { Class::Exact } else { Class::Outcomes };
    let mut verification = Verification {
        hash: entry.hash.clone(),
        weights: entry.weights()?.to_owned(),
        class,
        made_on: entry.processor.clone(),
        verified_on: cpu_level(),
        episodes: request.episodes,
        runs: entry.results.runs.len(),
        played,
        remarks: vec![],
        faults: vec![],
    };
    verification.judge(&again.differences);
    if class == Class::Outcomes {
        verification.compare_outcomes(&entry.results, &again.results);
    }
    Ok(verification)
}

/// Checks, before anything is played, that an entry was made on the device that plays it here.
fn check_device(path: &Path, entry: &Entry, home: &HomeResolver) -> Result<()> {
    let trained_on = home.checkpoint(&entry.checkpoint()?)?.info()?.manifest.device;
    let (theirs, ours) = (&entry.results.manifest.device, device::name_after(&Device::flex(), &trained_on));
    if *theirs == ours {
        return Ok(());
    }
    let problem = format!("was made on the device '{theirs}', and this is '{ours}'");
    let fix = "verify it without --exact, which tolerates a few differing episodes, or ask for an entry of this device";
    Err(Error::config(path.display().to_string(), problem, fix))
}

/// Returns the resolver of an entry's names, with those that the user replaces.
fn resolver<'a>(path: &Path, entry: &Entry, how: &'a How) -> Result<Replacing<'a>> {
    let origin = Origin::file(path, how.trust);
    let mut home = HomeResolver::new(origin);
    if let Some(env) = &how.env {
        let named = entry.request()?.env;
        if *env != named {
            let problem = format!("the results are of {named}");
            return Err(Error::config(format!("--env {env}"), problem, "name the environment of the entry"));
        }
        home = home.with_env(env);
    }
    if let Some(checkpoint) = &how.checkpoint {
        let loaded = HomeResolver::new(Origin::User).checkpoint(checkpoint)?;
        home = home.with_checkpoint(&entry.checkpoint()?, loaded);
    }
    Ok(Replacing { home, dataset: how.dataset.as_deref() })
}

/// Chooses the numbers of the episodes to play, in order.
fn numbers(episodes: usize, how: &How) -> Vec<usize> {
    let count = ((episodes as f64 * how.share).ceil() as usize).clamp(1, episodes.max(1));
    let key = Key::new(how.seed).with("verified episodes");
    let mut order: Vec<(u64, usize)> = (0..episodes).map(|number| (key.at(number as u64).seed(), number)).collect();
    order.sort_unstable();
    let mut chosen: Vec<usize> = order.into_iter().take(count).map(|(_, number)| number).collect();
    chosen.sort_unstable();
    chosen
}

impl Verification {
    /// Sorts the differences into remarks and faults, apart from the outcomes of a class that tolerates some.
    fn judge(&mut self, differences: &[Difference]) {
        for difference in differences {
            let is_outcome = difference.kind == Kind::Finding;
            match self.class {
                Class::Outcomes if is_outcome => {}
                Class::Outcomes if difference.what == "device" => self.remarks.push(difference.to_string()),
                _ => self.faults.push(difference.to_string()),
            }
        }
    }

    /// Compares the ends of the played episodes, of which [`TOLERANCE`] may differ.
    fn compare_outcomes(&mut self, old: &Results, new: &Results) {
        for (old, new) in old.runs.iter().zip(&new.runs) {
            let name = |run: &Run| format!("{}, {}", run.policy, run.condition);
            let pairs = self.played.iter().map(|&number| &old.episodes[number]).zip(&new.episodes);
            let differing = pairs.filter(|(old, new)| !ends_alike(old, new)).count();
            let allowed = (self.played.len() as f64 * TOLERANCE) as usize;
            let words = format!("{}: {differing} of {} episodes end differently", name(new), self.played.len());
            if differing > allowed {
                self.faults.push(format!("{words}, more than {allowed}"));
            } else if differing > 0 {
                self.remarks.push(words);
            }
        }
    }
}

/// Whether an episode ends as another one: success and steps are equal, and the sums of rewards up to [`REWARD_TOLERANCE`].
fn ends_alike(a: &EpisodeResult, b: &EpisodeResult) -> bool {
    let end = |episode: &EpisodeResult| (episode.success, episode.solved_at_start, episode.steps, episode.reached);
    let (a_reward, b_reward) = (a.total_reward, b.total_reward);
    let allowed = (REWARD_TOLERANCE * a_reward.abs().max(b_reward.abs())).max(SMALLEST_REWARD);
    // Infinite sums of the same sign are equal, and their difference is no number.
    let is_close = a_reward == b_reward || (a_reward - b_reward).abs() <= allowed && allowed.is_finite();
    end(a) == end(b) && (is_close || (a_reward.is_nan() && b_reward.is_nan()))
}

/// A resolver with a dataset that the user names in place of the entry's.
struct Replacing<'a> {
    home: HomeResolver,
    dataset: Option<&'a str>,
}

impl Resolver for Replacing<'_> {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        self.home.env(request)
    }

    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>> {
        match self.dataset {
            Some(own) => crate::home::open_dataset(own),
            None => self.home.dataset(name),
        }
    }

    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<ResolvedPolicy> {
        self.home.policy(request, world)
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        self.home.predictor(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{Counting, Timing};

    fn verification(class: Class, played: usize) -> Verification {
        Verification {
            hash: String::new(),
            weights: String::new(),
            class,
            made_on: String::new(),
            verified_on: String::new(),
            played: (0..played).collect(),
            episodes: played,
            runs: 1,
            remarks: vec![],
            faults: vec![],
        }
    }

    #[test]
    fn a_share_is_chosen_by_its_seed() {
        let chosen = |share: f64, seed: u64| numbers(200, &How { share, seed, ..How::default() });
        let some = chosen(0.1, 1);
        assert!(some.len() == 20 && some.is_sorted() && some.iter().all(|number| *number < 200), "{some:?}");
        assert!(some == chosen(0.1, 1) && some != chosen(0.1, 2));
        assert_eq!((chosen(1.0, 3), chosen(1e-9, 3).len()), ((0..200).collect(), 1));
        // Every episode is as likely as any other: 4000 draws of 20 among 200 have 400 ± 4 σ = 76 of each.
        let mut counts = [0_usize; 200];
        (0..4000).flat_map(|seed| chosen(0.1, seed)).for_each(|number| counts[number] += 1);
        assert!(counts.iter().all(|count| count.abs_diff(400) < 95), "{counts:?}");
    }

    #[test]
    fn another_processor_tolerates_some_outcomes_and_no_other_input() {
        let difference = |kind, what: &str| Difference { kind, what: what.to_owned(), was: "1".into(), is: "2".into() };
        let all = [
            difference(Kind::Version, "device"),
            difference(Kind::Version, "mujoco"),
            difference(Kind::Input, "hash of starts"),
            difference(Kind::Input, "hash of weights"),
            difference(Kind::Finding, "episode 3 of lewm, in distribution"),
        ];
        let judged = |class| {
            let mut found = verification(class, 40);
            found.judge(&all);
            (found.remarks.len(), found.faults)
        };
        assert_eq!(judged(Class::Exact), (0, all.iter().map(ToString::to_string).collect()));
        let (remarks, faults) = judged(Class::Outcomes);
        assert_eq!((remarks, faults.len()), (1, 3));
        for (fault, what) in faults.iter().zip(["mujoco", "hash of starts", "hash of weights"]) {
            assert!(fault.starts_with(what), "{faults:?}");
        }

        // 5 % of 40 episodes are two.
        let results = |solved: usize| {
            let episodes = (0..40).map(|i| EpisodeResult { success: i < solved, ..EpisodeResult::new(i as u64) });
            let run = Run::new("in distribution", "lewm", Counting::default(), episodes.collect(), Timing::default());
            Results { runs: vec![run], ..Results::default() }
        };
        for (solved, remarks, faults) in [(20, 0, 0), (22, 1, 0), (18, 1, 0), (23, 0, 1)] {
            let mut found = verification(Class::Outcomes, 40);
            found.compare_outcomes(&results(20), &results(solved));
            assert_eq!((found.remarks.len(), found.faults.len()), (remarks, faults), "{solved}");
        }
        // 5 % of 19 episodes are none.
        let mut few = verification(Class::Outcomes, 19);
        few.compare_outcomes(&results(10), &results(11));
        assert_eq!((few.remarks.len(), few.faults.len()), (0, 1), "{:?}", few.faults);
    }

    #[test]
    fn steps_and_rewards_of_an_episode_count_as_its_end() {
        let episode = EpisodeResult { success: true, steps: 20, total_reward: -80.0, ..EpisodeResult::new(1) };
        let alike = |change: &dyn Fn(&mut EpisodeResult)| {
            let mut other = episode.clone();
            change(&mut other);
            ends_alike(&episode, &other) && ends_alike(&other, &episode)
        };
        assert!(alike(&|_| {}) && alike(&|other| other.total_reward = -80.5));
        for reward in [-79.0, 80.0, 12345.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(!alike(&|other| other.total_reward = reward), "{reward}");
        }
        assert!(!alike(&|other| other.steps = 1) && !alike(&|other| other.reached = Some(3)));
        assert!(!alike(&|other| other.success = false) && !alike(&|other| other.solved_at_start = true));
        for reward in [0.0, f64::NAN, f64::INFINITY] {
            let same = EpisodeResult { total_reward: reward, ..episode.clone() };
            assert!(ends_alike(&same, &same.clone()), "{reward}");
        }
    }
}
