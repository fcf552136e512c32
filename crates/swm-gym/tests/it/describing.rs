//! Descriptions of environments that contradict themselves are refused: a worker process may send anything.

use swm_core::ResetOptions;
use swm_core::{Action, Env as _};
use swm_gym::{Description, Failure, GymEnv, Request, Transport};

/// Bytes of the buffer in [`DESCRIPTION`].
const SIZE: usize = 384;

/// A description with every kind of space, as `Bridge.describe` returns it.
const DESCRIPTION: &str = r#"{"action": {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1], "high": [1]},
"action_offset": 64, "columns": [{"name": "observation", "dtype": "float32", "shape": [4], "offset": 128}],
"observation": [["observation", {"type": "Box", "shape": [4], "dtype": "float32", "low": [null], "high": [null]}]],
"factors": [{"key": "agent.color", "space": {"type": "RGBBox"}, "init": [1, 2, 3]},
{"key": "wall", "space": {"type": "Discrete", "n": 3, "start": 0}, "init": [1]}],
"factors_offset": 192, "frame": {"size": [4, 4], "offset": 256}, "goal": null, "no_frame": "",
"pixel_art": false, "max_episode_steps": 50, "libraries": {}, "calls": [], "size": 384}"#;

/// A worker that sends a description and answers every request with an unchanged memory.
struct Worker(Description, Vec<u8>);

impl Transport for Worker {
    fn restart(&mut self) -> Result<(), Failure> {
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, Failure> {
        Ok(self.0.clone())
    }

    fn call(&mut self, _: Request<'_>) -> Result<(), Failure> {
        Ok(())
    }

    fn memory(&self) -> &[u8] {
        &self.1
    }

    fn memory_mut(&mut self) -> &mut [u8] {
        &mut self.1
    }
}

fn env(description: &str) -> swm_core::Result<GymEnv> {
    GymEnv::new("test/Env-v0", Box::new(Worker(Description::parse(description)?, vec![0; SIZE])), 0)
}

#[test]
fn inconsistent_descriptions_are_errors() {
    let mut intact = env(DESCRIPTION).expect("an environment");
    intact.reset(1, &ResetOptions::default()).expect("a reset");
    intact.step(Action::Continuous(&[0.5, 0.5])).expect("a step");
    for (from, to, expected) in [
        // The fuzzer `worker` found this: a step wrote 8 bytes of an action to a region of 16 and panicked.
        (r#"[2], "dtype": "float32""#, r#"[2], "dtype": "float64""#, "float32 or integers"),
        (r#""shape": [2]"#, r#""shape": [0]"#, "float32 or integers"),
        (r#""shape": [2]"#, r#""shape": [1099511627776]"#, "at most 384 elements"),
        (r#""shape": [4], "offset""#, r#""shape": [4294967296, 4294967296], "offset""#, "at most 384 elements"),
        (r#""offset": 128"#, r#""offset": 18446744073709551615"#, "384"),
        (r#""action_offset": 64"#, r#""action_offset": 18446744073709551615"#, "384"),
        (r#""factors_offset": 192"#, r#""factors_offset": 18446744073709551615"#, "384"),
        (r#""size": [4, 4]"#, r#""size": [4294967296, 4294967296]"#, "384"),
        (r#""size": [4, 4]"#, r#""size": [0, 4]"#, "at least 1 x 1"),
        (r#""n": 3, "start": 0"#, r#""n": 0, "start": 0"#, "bounds with values"),
        (r#""n": 3, "start": 0"#, r#""n": 3, "start": 9223372036854775807"#, "bounds with values"),
        (
            r#"steps": 50"#,
            r#"steps": 99999999999999999999"#,
            "max_episode_steps: 1e+20 is no time limit; choose from 1",
        ),
        (r#"steps": 50"#, r#"steps": -1"#, "-1 is no time limit"),
        (r#"steps": 50"#, r#"steps": "long""#, "\"long\" is no time limit"),
        (r#""low": [-1], "high": [1]"#, r#""low": [1], "high": [-1]"#, "bounds with values"),
    ] {
        assert_eq!(DESCRIPTION.matches(from).count(), 1, "{from}");
        let error = env(&DESCRIPTION.replace(from, to)).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(error.contains(expected), "{to}: {error}");
    }
}
