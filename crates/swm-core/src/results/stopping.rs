//! [`Stopping`]: how an evaluation ended whose number of episodes its results decided.

use super::{Comparing, Comparison, Paired, Proportion, Results, Until};
use serde::{Deserialize, Serialize};
use std::fmt;

/// How an evaluation ended whose number of episodes its results decided. Its intervals are confidence sequences, and its
/// verdicts follow e-values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stopping {
    /// The rule.
    pub until: Until,
    /// The largest number of episodes.
    pub most: usize,
    /// Whether the rule is met. Otherwise the evaluation has the largest number of episodes, or was interrupted.
    pub met: bool,
}

impl Stopping {
    /// What this says about the statistics of an evaluation with `episodes` episodes for each run, in a sentence.
    pub fn note(&self, episodes: usize) -> String {
        format!(
            "{}: intervals are confidence sequences and p-values are 1 / e, which hold at any number",
            self.end(episodes)
        )
    }

    fn end(&self, episodes: usize) -> String {
        let Self { until, most, met } = self;
        match (met, episodes < *most) {
            (true, _) => format!("Stopped by {until} after {episodes} of at most {most} starts"),
            (false, true) => format!("Interrupted after {episodes} of at most {most} starts, before {until} was met"),
            (false, false) => format!("Ended with the largest number of starts, {most}, and {until} not met"),
        }
    }
}

impl fmt::Display for Stopping {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.until.fmt(f)
    }
}

impl Results {
    /// Gives results the statistics of an evaluation that `until` ends, after at most `most` episodes: those that hold at
    /// every number of episodes.
    #[must_use]
    pub fn stopped(mut self, until: Until, most: usize) -> Self {
        let rate = |p: Proportion| Proportion::sequential(p.successes, p.n);
        for run in &mut self.runs {
            run.success = rate(run.success);
            run.strict = run.strict.map(rate);
        }
        self.comparisons = Comparison::all_by(Paired::sequential, &self.runs, self.counting);
        self.stopping = Some(Stopping { until, most, met: false });
        let met = self.meets(until);
        self.stopping = Some(Stopping { until, most, met });
        self
    }

    /// The number of episodes of each run.
    pub fn episodes(&self) -> usize {
        self.runs.first().map_or(0, |run| run.episodes.len())
    }

    /// Whether no more episodes are needed. `ci` asks for the rates of all policies but the random-policy floor, `decided` for
    /// all comparisons and gaps.
    pub(super) fn meets(&self, until: Until) -> bool {
        match until {
            Until::Width(_) => {
                let (mut learned, every) = (self.runs.iter().filter(|run| run.policy != "random"), &self.runs);
                let only_floor = every.iter().all(|run| run.policy == "random");
                let is_narrow = |p: &Proportion| until.is_narrow(p);
                if only_floor {
                    every.iter().all(|run| is_narrow(&run.success))
                } else {
                    learned.all(|run| is_narrow(&run.success))
                }
            }
            Until::Decided(_) => {
                let gaps = self.gaps().0;
                let mut tables = self.comparisons.iter().map(|c| &c.table).chain(gaps.iter().map(|gap| &gap.table));
                tables.all(|table| until.is_decided(table))
            }
        }
    }

    /// The comparison of two runs: that of a fixed number of episodes, or that of an evaluation that its results ended.
    pub fn comparing(&self) -> Comparing {
        if self.stopping.is_some() { Paired::sequential } else { Paired::of_runs }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{Counting, EpisodeResult, Run, Timing};

    fn run(condition: &str, policy: &str, successes: usize, n: usize) -> Run {
        let episodes = (0..n).map(|i| EpisodeResult { success: i < successes, ..EpisodeResult::new(i as u64) });
        Run::new(condition, policy, Counting::default(), episodes.collect(), Timing::default())
    }

    fn results(n: usize) -> Results {
        let runs = vec![
            run("in distribution", "random", n / 10, n),
            run("in distribution", "model", n - 2, n),
            run("red", "random", n / 10, n),
            run("red", "model", n / 2, n),
        ];
        Results { comparisons: Comparison::all(&runs, Counting::default()), runs, ..Results::default() }
    }

    #[test]
    fn stopped_results_have_confidence_sequences_and_refuse_others() {
        let fixed = results(40);
        let stopped = fixed.clone().stopped("decided".parse().expect("a rule"), 200);
        stopped.check().expect("consistent results");
        let [narrow, wide] =
            [&fixed, &stopped].map(|results| results.runs[1].success.high - results.runs[1].success.low);
        assert!(wide > narrow, "{wide} {narrow}");
        assert!(stopped.comparisons.iter().all(|comparison| comparison.table.e.is_some()));
        assert!(stopped.gaps().1.iter().all(|family| family.sequential));
        // Removing the rule does not make the intervals those of a fixed number, and adding it does not make them sequences.
        assert!(Results { stopping: None, ..stopped.clone() }.check().is_err());
        assert!(Results { stopping: stopped.stopping, ..fixed }.check().is_err());
        let denied = stopped.stopping.map(|stopping| Stopping { met: !stopping.met, ..stopping });
        let error = Results { stopping: denied, ..stopped.clone() }.check().expect_err("another end");
        assert!(error.contains("decided=10"), "{error}");
        let few = stopped.stopping.map(|stopping| Stopping { most: 39, ..stopping });
        assert!(Results { stopping: few, ..stopped }.check().expect_err("too many").contains("39"));
    }

    #[test]
    fn several_starts_of_one_recorded_episode_are_refused() {
        let mut stopped = results(40).stopped("decided".parse().expect("a rule"), 200);
        let start = |results: &mut Results, start: fn(usize) -> [usize; 2]| {
            for run in &mut results.runs {
                run.episodes.iter_mut().enumerate().for_each(|(i, episode)| episode.start = Some(start(i)));
            }
        };
        start(&mut stopped, |i| [i, 3]);
        stopped.check().expect("one start per episode");
        start(&mut stopped, |i| [i / 2, i]);
        let error = stopped.check().expect_err("two starts per episode");
        assert!(error.contains("several starts of the recorded episode 0"), "{error}");
        // The cell of a study has the statistics of a fixed number, and its rows those of any number.
        let mut cell = Results { sequential: true, ..results(40) };
        start(&mut cell, |i| [i / 2, i]);
        assert!(cell.check().is_err_and(|error| error.contains("several starts")));
    }

    #[test]
    fn a_rule_is_met_by_all_policies_or_all_comparisons() {
        let met = |n: usize, rule: &str| {
            let stopped = results(n).stopped(rule.parse().expect("a rule"), 5000);
            stopped.stopping.is_some_and(|stopping| stopping.met)
        };
        // The model's rate of one half needs the most starts; the floor needs none.
        assert!(!met(200, "ci=5") && met(2000, "ci=5") && met(200, "ci=20"));
        // Equal floors under both conditions are never told apart, so their gap has to be shown to be small.
        assert!(!met(20, "decided=10") && met(400, "decided=10"));
        let floor = vec![run("in distribution", "random", 50, 100)];
        let only = |points: &str| {
            Results { runs: floor.clone(), ..Results::default() }.stopped(points.parse().expect("a rule"), 100)
        };
        assert!(!only("ci=5").meets(Until::Width(5.0)) && only("ci=20").meets(Until::Width(20.0)));
    }

    #[test]
    fn an_end_is_described() {
        let of = |met, most| Stopping { until: Until::Width(5.0), most, met }.note(50);
        assert!(of(true, 80).starts_with("Stopped by ci=5 after 50 of at most 80 starts: "), "{}", of(true, 80));
        assert!(of(false, 80).starts_with("Interrupted after 50 of at most 80 starts"), "{}", of(false, 80));
        assert!(of(false, 50).contains("largest number of starts, 50, and ci=5 not met"), "{}", of(false, 50));
    }
}
