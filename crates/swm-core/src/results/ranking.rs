//! [`Ranking`]: the ranks of policies that played the same starts, as far as their results tell them apart.
//!
//! An order by success rates is mostly an order by chance. A rank is therefore a range: it begins behind the policies that
//! are told apart as better, and ends before those that are told apart as worse.

use super::{Counting, Family, Paired, Run, Verdict};

/// The range of the ranks that a policy may have; 1 is the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rank {
    /// 1 + the number of policies that are told apart as better.
    pub best: usize,
    /// The number of policies that are not told apart as worse, itself included.
    pub worst: usize,
}

/// The ranks of policies, and the comparisons that decide them.
#[derive(Clone, Debug, PartialEq)]
pub struct Ranking {
    /// The rank of each policy, in the given order.
    pub ranks: Vec<Rank>,
    /// All comparisons as a family; `None` with fewer than two policies that played the same starts.
    pub family: Option<Family>,
}

impl Ranking {
    /// Compares every pair of runs on the starts that they share, as one family: all ranks hold together with a probability
    /// of 95 %. Runs that did not play the same starts are not told apart.
    pub fn of(runs: &[&Run], counting: Counting) -> Self {
        let pairs = (0..runs.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
        let compared = pairs.filter_map(|(a, b)| Some(((a, b), Paired::of_runs(runs[a], runs[b], counting)?)));
        let mut compared: Vec<((usize, usize), Paired)> = compared.collect();
        let mut tables: Vec<&mut Paired> = compared.iter_mut().map(|(_, table)| table).collect();
        let family = Family::correct("", &mut tables, 0);
        let mut ranks = vec![Rank { best: 1, worst: runs.len() }; runs.len()];
        for ((a, b), table) in compared {
            let (better, worse) = match table.verdict {
                Verdict::Higher => (a, b),
                Verdict::Lower => (b, a),
                Verdict::NotToldApart | Verdict::TooFew => continue,
            };
            ranks[better].worst -= 1;
            ranks[worse].best += 1;
        }
        Self { ranks, family }
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init, reason = "a list of the ranges of solved episodes may have one range")]
mod tests {
    use super::*;
    use crate::results::{EpisodeResult, Timing};

    /// A run that solves the starts in these ranges, of 100.
    fn run(name: &str, seed: u64, solved: &[std::ops::Range<u64>]) -> Run {
        let episodes = (0..100).map(|i| EpisodeResult {
            success: solved.iter().any(|range| range.contains(&i)),
            ..EpisodeResult::new(seed + i)
        });
        Run::new("in distribution", name, Counting::default(), episodes.collect(), Timing::default())
    }

    fn ranks(runs: &[Run]) -> Vec<[usize; 2]> {
        let runs: Vec<&Run> = runs.iter().collect();
        Ranking::of(&runs, Counting::default()).ranks.iter().map(|rank| [rank.best, rank.worst]).collect()
    }

    #[test]
    fn ranks_are_those_that_the_comparisons_tell_apart() {
        // 80 and 76 of 100 differ in 4 starts, which decide nothing; both differ from 20 in at least 56.
        let runs = [run("a", 0, &[0..80]), run("b", 0, &[0..20]), run("c", 0, &[0..76])];
        assert_eq!(ranks(&runs), [[1, 2], [3, 3], [1, 2]]);
        assert_eq!(ranks(&runs[..2]), [[1, 1], [2, 2]]);
        // 7 differing starts, all in one direction, tell two policies apart (z = √7 = 2.65 > 1.96), but not among three:
        // the level 5 % / 3 needs z = 2.39 < 2.65, and among five 5 % / 10, z = 2.81.
        let [a, b] = [run("a", 0, &[0..57]), run("b", 0, &[0..50])];
        assert_eq!(ranks(&[a.clone(), b.clone()]), [[1, 1], [2, 2]]);
        let far = run("c", 0, &[]);
        assert_eq!(ranks(&[a.clone(), b.clone(), far.clone()]), [[1, 1], [2, 2], [3, 3]]);
        let five = [a, b, far.clone(), far.clone(), far];
        assert_eq!(ranks(&five), [[1, 2], [1, 2], [3, 5], [3, 5], [3, 5]]);
    }

    #[test]
    fn runs_on_other_starts_are_not_told_apart() {
        let runs = [run("a", 0, &[0..90]), run("b", 1, &[0..5])];
        assert_eq!(ranks(&runs), [[1, 2], [1, 2]]);
        let ranking = Ranking::of(&[&runs[0], &runs[1]], Counting::default());
        assert!(ranking.family.is_none());
        assert_eq!(ranks(&runs[..1]), [[1, 1]]);
        assert_eq!(ranks(&[]), [[0; 2]; 0]);
    }
}
