//! Tests of Gymnasium environments on the command line. They require a Python with Gymnasium, which `$SWM_PYTHON`
//! names.

use crate::{Swm, text};

/// Whether `$SWM_PYTHON` is set and has a module. Gymnasium is required; other modules may be missing.
pub fn python(module: &str) -> bool {
    let Some(program) = std::env::var_os("SWM_PYTHON").filter(|value| !value.is_empty()) else {
        println!("SKIPPED: set SWM_PYTHON to a Python with Gymnasium, as `make test` does");
        return false;
    };
    let command = format!("import {module}");
    let output = std::process::Command::new(program).args(["-c", &command]).output().expect("$SWM_PYTHON starts");
    assert!(output.status.success() || module != "gymnasium", "{}", text(&output.stderr));
    if !output.status.success() {
        println!("SKIPPED: $SWM_PYTHON has no {module}");
    }
    output.status.success()
}

#[test]
fn gymnasium_environments_are_collected_and_evaluated() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    let collect = ["collect", "CartPole-v1", "--policy", "random", "--episodes", "5", "--image", "32", "--seed", "4"];
    let with = |more: &[&str]| {
        let args: Vec<&str> = collect.iter().chain(more).copied().collect();
        swm.json(&args);
    };
    with(&["-o", "one", "--envs", "1"]);
    with(&["-o", "three", "--envs", "3", "--threads", "2"]);
    with(&["-o", "noisy", "--envs", "2", "--wrapper", "noise"]);
    let [one, three, noisy] = ["one", "three", "noisy"].map(|name| swm.json(&["inspect", name]));
    assert_eq!(one["content_hash"], three["content_hash"], "the content does not depend on environments and threads");
    assert_ne!(one["content_hash"], noisy["content_hash"], "a wrapper changes frames");
    assert_eq!((&one["episodes"], &one["steps"]), (&noisy["episodes"], &noisy["steps"]));
    assert!(one["manifest"]["libraries"]["gymnasium"].is_string(), "{}", one["manifest"]);
    swm.json(&["eval", "random", "--env", "CartPole-v1", "--episodes", "3", "--image", "32", "-o", "floor"]);
    assert_eq!(swm.json(&["fovs", "CartPole-v1"])["variation"], serde_json::json!({}));
    swm.fails(&["collect", "CartPoel-v1", "-o", "x", "--policy", "random"], 2, &["did you mean CartPole-v1"]);
    swm.fails(&["collect", "CartPole-v1", "-o", "x"], 2, &["CartPole-v1 has no experts"]);
    let mut command = swm.command(&["envs", "CartPole-v1"]);
    let output = command.env("SWM_PYTHON", "/no/such/python").output().expect("swm starts");
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("/no/such/python (named by $SWM_PYTHON)"), "{}", text(&output.stderr));
}

/// An environment whose state grows in every step by a value that depends on the seed and not on the action. An episode
/// that starts from a recorded state therefore reaches all later recorded states.
const TRAIN: &str = "
import gymnasium, numpy as np
from gymnasium import spaces

class Train(gymnasium.Env):
    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.speed = self.np_random.uniform(1, 2)
        self.set_state(np.zeros(1))
        self.set_goal_state(np.full(1, 1e9))
        return self.at, {'state': self.at}

    def set_state(self, state):
        self.at = state

    def set_goal_state(self, goal_state):
        self.goal = goal_state

    def step(self, action):
        self.at = self.at + self.speed
        return self.at, 0.0, bool(self.at >= self.goal - 1e-9), False, {'state': self.at}

gymnasium.register('Train-v0', Train, max_episode_steps=20)
";

#[test]
fn environment_with_state_setters_starts_from_a_dataset() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    std::fs::write(swm.path("trains.py"), TRAIN).expect("writing the module");
    let train = "trains:Train-v0";
    swm.json(&["collect", train, "-o", "trains", "--policy", "random", "--episodes", "3", "--no-pixels"]);
    let eval = ["eval", "random", "--env", train, "--dataset", "trains", "--goal-offset", "4", "--episodes", "6"];
    let with = |more: &[&str]| swm.json(&eval.iter().chain(more).copied().collect::<Vec<_>>());
    let results = with(&["--no-pixels", "--envs", "2", "-o", "two"]);
    let episodes = results["runs"][0]["episodes"].as_array().expect("an array of episodes");
    assert_eq!(episodes.len(), 6);
    assert!(episodes.iter().all(|episode| episode["success"] == true && episode["steps"] == 4), "{episodes:?}");
    swm.json(&["collect", "CartPole-v1", "-o", "carts", "--policy", "random", "--episodes", "2", "--no-pixels"]);
    let cart =
        ["eval", "random", "--env", "CartPole-v1", "--dataset", "carts", "--goal-offset", "2", "--episodes", "2"];
    swm.fails(&cart, 2, &["starting CartPole-v1 from a row of a dataset", "set_state(state)"]);
}

/// The robustness sweep of the paper's Atari listing, with three wrappers.
#[test]
fn wrappers_change_atari_frames() {
    if !python("ale_py") {
        return;
    }
    let swm = Swm::new();
    let sweep = [None, Some("noise"), Some("blur"), Some("color-jitter")];
    let hashes = sweep.map(|wrapper| {
        let name = wrapper.unwrap_or("plain");
        let mut args = vec!["collect", "ALE/Pong-v5", "-o", name, "--policy", "random", "--episodes", "2"];
        args.extend(["--max-steps", "5", "--image", "64", "--envs", "2"]);
        args.extend(wrapper.into_iter().flat_map(|name| ["--wrapper", name]));
        swm.json(&args);
        let found = swm.json(&["inspect", name]);
        assert!(found["manifest"]["libraries"]["ale-py"].is_string(), "{}", found["manifest"]);
        found["content_hash"].as_str().expect("the hash is a string").to_owned()
    });
    for (i, hash) in hashes.iter().enumerate() {
        assert!(!hashes[..i].contains(hash), "{:?} has no effect", sweep[i]);
    }
}
