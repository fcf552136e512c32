//! [`warning_of_starts`]: whether the starts of an evaluation were recorded in its environment.

use crate::home;

/// Returns a warning if a dataset was recorded in another environment than the one that starts from its rows, whose states may mean
/// something else. A dataset that cannot be opened has none: that is an error of the evaluation.
pub fn warning_of_starts(dataset: &str, env: &str) -> Option<String> {
    let manifest = home::open_dataset(dataset).ok()?.manifest()?;
    let recorded = manifest.config["env"].as_str()?;
    (simulator(recorded) != simulator(env))
        .then(|| format!("{dataset} was collected in {recorded}, and its states are starts in {env} here"))
}

/// Returns the id of an environment without its module, settings and version, and without the words for variants of actions,
/// observations and rewards, which share a simulator.
fn simulator(env: &str) -> String {
    let id = env.split(',').next().unwrap_or_default().rsplit(':').next().unwrap_or_default();
    let name = match id.rsplit_once("-v") {
        Some((name, version)) if version.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => id,
    };
    ["-Discrete", "Discrete", "Dense", "Sparse", "Dict"]
        .iter()
        .fold(name.to_owned(), |name, word| name.replace(word, ""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_share_a_simulator_and_other_environments_do_not() {
        for (a, b) in [
            ("swm/PushT-v1", "swm/PushT-Discrete-v1"),
            ("swm/FetchReach-v3,size=3", "swm/FetchReachDense-v4"),
            ("my_envs:Maze-v0", "Maze-v0"),
        ] {
            assert_eq!(simulator(a), simulator(b));
        }
        assert_ne!(simulator("swm/TwoRoom-v1"), simulator("swm/Piecewise-v0"));
    }
}
