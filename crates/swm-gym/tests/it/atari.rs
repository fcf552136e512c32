//! Tests of the Arcade Learning Environment and of Craftax.

use crate::play::{RecordedEnv, make, play};
use crate::{can_import, config};
use swm_core::{Action, DType, ResetOptions, Space};

#[test]
fn frame_of_pong_equals_its_observation() {
    let Some(config) = config().filter(|config| can_import(config, "ale_py")) else { return };
    let mut env = RecordedEnv::of(make("ALE/Pong-v5", &config));
    assert_eq!(env.env.spec().action_space, Space::Discrete { n: 6, start: 0 });
    assert!(env.env.libraries().contains_key("ale-py"), "{:?}", env.env.libraries());
    env.env.reset(1, &ResetOptions::default()).expect("resetting the environment");
    for _ in 0..30 {
        env.env.step(Action::Discrete(&[2])).expect("stepping the environment");
    }
    let observed = env.column("observation");
    let frame = env.frame(210, 160);
    assert!(observed.iter().zip(&frame).all(|(&a, &b)| a == f64::from(b)), "the frame is the observation");
    assert!(frame.chunks_exact(3).any(|pixel| pixel != &frame[..3]), "the frame has more than one colour");
    assert!(play("ALE/Pong-v5", &config, &[0, 1], 2, 5)[1] == play("ALE/Pong-v5", &config, &[1], 1, 5)[0]);
}

#[test]
#[ignore = "JAX compiles for minutes"]
fn craftax_steps_and_renders() {
    let Some(config) = config().filter(|config| can_import(config, "craftax")) else { return };
    for (id, shape, actions) in [
        ("swm/CraftaxClassicPixels-v1", &[63, 63, 3][..], 17),
        ("swm/CraftaxClassicSymbolic-v1", &[1345], 17),
        ("swm/CraftaxPixels-v1", &[130, 110, 3], 43),
        ("swm/CraftaxSymbolic-v1", &[8268], 43),
    ] {
        let mut env = RecordedEnv::of(make(id, &config));
        let spec = env.env.spec();
        assert_eq!(spec.action_space, Space::Discrete { n: actions, start: 0 }, "{id}");
        let observation = &spec.columns[0];
        assert_eq!((&observation.shape[..], observation.dtype), (shape, DType::Float32), "{id}");
        env.env.reset(0, &ResetOptions::default()).expect("resetting the environment");
        for action in [1, 2, 3, 4, 5] {
            env.env.step(Action::Discrete(&[action])).expect("stepping the environment");
        }
        assert!(env.env.libraries().contains_key("craftax"), "{id}");
        let frame = env.frame(64, 64);
        assert!(frame.chunks_exact(3).any(|pixel| pixel != &frame[..3]), "{id}: the frame has more than one colour");
    }
}
