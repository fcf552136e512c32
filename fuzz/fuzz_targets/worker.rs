//! The description and the memory that a worker process sends. The input is the text of a description, a zero byte, and
//! the content of the memory.

#![no_main]

use swm_core::{Action, Batch, Env as _, FrameMut, ResetOptions, Schema, Space};
use swm_gym::{Description, Failure, GymEnv, Request, Transport};

/// Memory of a worker that the fuzzer maps at most, in bytes.
const MAX_MEMORY: usize = 1 << 20;

struct Input {
    description: Description,
    memory: Vec<u8>,
}

impl Transport for Input {
    fn restart(&mut self) -> Result<(), Failure> {
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, Failure> {
        Ok(self.description.clone())
    }

    fn call(&mut self, _: Request<'_>) -> Result<(), Failure> {
        Ok(())
    }

    fn memory(&self) -> &[u8] {
        &self.memory
    }

    fn memory_mut(&mut self) -> &mut [u8] {
        &mut self.memory
    }
}

/// A description with every kind of space, as `Bridge.describe` returns it.
const DESCRIPTION: &str = r#"{"action": {"type": "Box", "shape": [2], "dtype": "float32", "low": [-1], "high": [1]},
"action_offset": 64, "columns": [{"name": "observation", "dtype": "float32", "shape": [4], "offset": 128}],
"observation": [["observation", {"type": "Box", "shape": [4], "dtype": "float32", "low": [null], "high": [null]}]],
"factors": [{"key": "agent.color", "space": {"type": "RGBBox"}, "init": [1, 2, 3]},
{"key": "wall", "space": {"type": "Discrete", "n": 3, "start": 0}, "init": [1]},
{"key": "walls", "space": {"type": "MultiDiscrete", "nvec": [3, 2], "start": [0, 0]}, "init": [1, 1]}],
"factors_offset": 192, "frame": {"size": [4, 4], "offset": 256}, "goal": {"size": [4, 4], "offset": 320}, "no_frame": "",
"pixel_art": false, "max_episode_steps": 50, "libraries": {"gymnasium": "1.2.0"}, "calls": [], "size": 384}"#;

libfuzzer_sys::fuzz_target!(
    init: swm_fuzz::seed("description", DESCRIPTION.as_bytes()),
    |bytes: &[u8]| {
        let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
        let (text, content) = bytes.split_at(end);
        let Ok(description) = std::str::from_utf8(text).map_err(drop).and_then(|text| Description::parse(text).map_err(drop))
        else {
            return;
        };
        // The process maps what the worker allocated, and refuses memory shorter than the description says.
        if description.size > MAX_MEMORY {
            return;
        }
        let mut memory = vec![0; description.size];
        for (byte, &given) in memory.iter_mut().zip(content) {
            *byte = given;
        }
        let Ok(mut env) = GymEnv::new("fuzz/Env-v0", Box::new(Input { description, memory }), 0) else { return };
        if env.reset(1, &ResetOptions::default()).is_err() {
            return;
        }
        let spec = env.spec().clone();
        let (floats, integers) = (vec![0.0; spec.action_dim()], vec![0; spec.action_dim()]);
        let action = match &spec.action_space {
            Space::Box { .. } => Action::Continuous(&floats),
            _ => Action::Discrete(&integers),
        };
        let _ = env.step(action);
        if let Ok(schema) = Schema::new(spec.columns) {
            env.observe(&mut Batch::zeros(&schema, 1).row_mut(0));
        }
        let mut rgb = vec![0; 8 * 8 * 3];
        let _ = env.render(FrameMut::new(8, 8, &mut rgb));
        let _ = env.render_goal(FrameMut::new(8, 8, &mut rgb));
        let snapshot = env.snapshot();
        let _ = env.restore(&snapshot);
    }
);
