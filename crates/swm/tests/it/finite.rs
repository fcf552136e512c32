//! Tests that NaN and infinite values are counted or refused (docs/security.md).

use crate::gym::python;
use crate::{Swm, text};
use serde_json::json;

/// An environment whose second reward is NaN and whose third observation has an infinite value.
const MODULE: &str = "
import gymnasium, numpy as np
from gymnasium import spaces

class Faulty(gymnasium.Env):
    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, fault=True):
        self.fault = fault

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2), {}

    def step(self, action):
        self.t += 1
        reward = float('nan') if self.fault and self.t == 2 else 1.0
        far = np.inf if self.fault and self.t == 3 else 0.0
        return np.array([self.t, far]), reward, False, False, {}

gymnasium.register('Faulty-v0', Faulty, max_episode_steps=5)
";

#[test]
fn values_that_are_not_finite_are_counted_or_refused() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    std::fs::write(swm.path("faulty.py"), MODULE).expect("a module");
    let collect = |env: &str, more: &[&str]| {
        let args = ["collect", env, "--policy", "random", "--no-pixels", "--envs", "2"];
        let output = swm.run(&[&args[..], more].concat());
        (output.status.code(), text(&output.stderr))
    };
    let counts = |name: &str| swm.json(&["inspect", name])["manifest"]["not_finite"].clone();

    let (code, error) = collect("faulty:Faulty-v0", &["-o", "bad", "--episodes", "2"]);
    assert_eq!(code, Some(0), "{error}");
    assert!(error.contains("2 in 'observation', 2 in 'reward'") && error.contains("--strict-finite"), "{error}");
    assert!(error.contains("'reward' has NaN or infinite values"), "the environment's first one is reported: {error}");
    assert_eq!(counts("bad"), json!({"observation": 2, "reward": 2}));
    collect("faulty:Faulty-v0", &["-o", "bad", "--episodes", "3", "--resume"]);
    assert_eq!(counts("bad"), json!({"observation": 3, "reward": 3}), "a resumed collection adds its own");

    for shard in [&["0/2"][..], &["1/2"], &["0/2", "--resume"]] {
        let args = [&["-o", "sharded", "--episodes", "3", "--shard"], shard].concat();
        let (code, error) = collect("faulty:Faulty-v0", &args);
        assert_eq!(code, Some(0), "{error}");
    }
    swm.json(&["datasets", "commit", "sharded"]);
    assert_eq!(counts("sharded"), json!({"observation": 3, "reward": 3}), "the commit adds the counts of the shards");

    let (code, error) = collect("faulty:Faulty-v0", &["-o", "strict", "--episodes", "2", "--strict-finite"]);
    assert_eq!(code, Some(1), "{error}");
    assert!(error.contains("column 'observation' of episode 0 is not finite: 1 of 12 values"), "{error}");

    let (code, error) = collect("faulty:Faulty-v0,fault=false", &["-o", "good", "--episodes", "2", "--strict-finite"]);
    assert_eq!((code, counts("good")), (Some(0), serde_json::Value::Null), "{error}");
    assert!(!error.contains("finite"), "{error}");
}
