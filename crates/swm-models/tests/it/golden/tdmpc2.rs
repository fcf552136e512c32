//! TD-MPC2: latents, predictions, values and costs; losses and gradients of a training step.

use super::{Golden, TOLERANCE, check, error, files, values};
use burn::tensor::Tensor;
use swm_models::Checkpoint;
use swm_models::nn::{DropoutRng, Ensemble, Named, parameters, two_hot};
use swm_models::tdmpc2::step::{Draws, Tdmpc2Step, TrainBatch, step};
use swm_models::tdmpc2::{LossConfig, Observation, Published, Rollouts, Tdmpc2, Tdmpc2Config, export, import};
use swm_models::train::{DatasetInfo, TrainConfig};
use swm_plan::ActionScale;

impl Golden {
    fn world_model_setting(&self, name: &str) -> f64 {
        self.config["wm"][name].as_f64().expect(name)
    }

    fn tdmpc2(&self) -> (Tdmpc2, Published) {
        let published = Published::read(&self.text).expect("reading the published configuration");
        (published.with(&self.group("w."), &crate::device()).expect("published weights"), published)
    }
}

fn forward_files() -> impl Iterator<Item = Golden> {
    files("tdmpc2").into_iter().map(|file| Golden::read(&file)).filter(|golden| golden.tensors.contains_key("o.cost"))
}

#[test]
fn network_outputs_and_costs_equal_the_reference() {
    for golden in forward_files() {
        let (model, published) = golden.tdmpc2();
        let config = published.model();
        let z = model.encode(Observation { pixels: None, columns: vec![golden.tensor("i.state")] });
        check(&golden, "o.z", &values(z.clone()));
        let [envs, samples, horizon, width] = golden.tensor::<4>("i.candidates").dims();
        let first = golden.tensor::<4>("i.candidates").slice([0..envs, 0..1, 0..1, 0..width]).reshape([envs, width]);
        let input = Tensor::cat(vec![z.clone(), first], 1);
        check(&golden, "o.next_z", &values(model.next(input.clone())));
        let logits = model.reward.forward(input.clone());
        check(&golden, "o.reward_logits", &values(logits.clone()));
        check(&golden, "o.reward", &values(config.bins.expectation(logits)));
        check(&golden, "o.pi", &values(model.pi.forward(z.clone())));
        let critics = Ensemble::of(&model.qs.iter().collect::<Vec<_>>());
        check(&golden, "o.q_logits", &values(critics.forward(input, 0.0, &mut DropoutRng::disabled())));

        let scalars = golden.tensor::<1>("i.values");
        check(&golden, "o.symlog", &values(two_hot::symlog(scalars.clone())));
        check(&golden, "o.symexp", &values(two_hot::symexp(scalars.clone() * 0.2)));
        check(&golden, "o.two_hot", &values(config.bins.two_hot(scalars)));

        let rollouts = Rollouts::new(
            &model,
            golden.world_model_setting("discount"),
            golden.world_model_setting("uncertainty_penalty"),
        );
        let (latents, actions) = (values(z), values(golden.tensor::<4>("i.candidates")));
        let mut costs = vec![0.0; envs * samples];
        for (env, costs) in costs.chunks_mut(samples).enumerate() {
            let latent = &latents[env * config.latent()..][..config.latent()];
            rollouts.cost(
                latent,
                &actions[env * samples * horizon * width..][..samples * horizon * width],
                horizon,
                costs,
            );
        }
        check(&golden, "o.cost", &costs);
    }
}

#[test]
fn exported_checkpoints_round_trip() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for golden in forward_files() {
        let (model, published) = golden.tdmpc2();
        let mut config = TrainConfig::<Tdmpc2>::load("paper", &[]).expect("loading the configuration");
        (config.model, config.loss) = (published.model(), published.loss());
        let action = ActionScale::identity(model.action_dim());
        let dataset_info = DatasetInfo { action, columns: Named::new(), env: None };
        let manifest = swm_core::Manifest::new("test", 0, serde_json::Value::Null);
        let checkpoint = Checkpoint { model, config, dataset_info: dataset_info.clone(), manifest };
        export(&checkpoint, folder.path()).expect("exporting the checkpoint");
        let again = import(folder.path(), dataset_info).expect("importing the checkpoint");
        assert_eq!(parameters::values(&again.model), parameters::values(&checkpoint.model));
        assert_eq!((&again.config.model, &again.config.loss), (&checkpoint.config.model, &checkpoint.config.loss));
        let other = DatasetInfo { action: ActionScale::identity(1), columns: Named::new(), env: None };
        assert!(
            import(folder.path(), other).expect_err("another action dimension").to_string().contains("action elements")
        );
    }
}

#[test]
fn training_losses_and_gradients_equal_the_reference() {
    let mut checked_files = 0;
    for file in files("tdmpc2") {
        let golden = Golden::read(&file);
        if !golden.tensors.contains_key("o.train.loss") {
            continue;
        }
        checked_files += 1;
        let (model, published) = golden.tdmpc2();
        let (config, loss) = (published.model(), published.loss());
        for shards in [1, 3] {
            let ended = golden.train(&model, &config, &loss, "o.terminated", true, shards);
            check(&golden, "o.terminated.value", &[ended.value as f32]);
            let step = golden.train(&model, &config, &loss, "o.train", false, shards);
            for (name, actual) in [
                ("loss", step.total),
                ("consist", step.consistency),
                ("reward", step.reward),
                ("value", step.value),
                ("policy", step.policy),
                ("scale", f64::from(step.scale)),
            ] {
                check(&golden, &format!("o.train.{name}"), &[actual as f32]);
            }
            let expected = golden.group("g.");
            let weight = |name: &str| if name.starts_with("pi.") { &step.policy } else { &step.total };
            for (name, gradient) in &expected {
                let actual = values(step.gradients.get(name).unwrap_or_else(|| panic!("a gradient of {name}")).clone());
                let error = error(&actual, &gradient.values, 1e-6 * weight(name).abs() as f32);
                assert!(error < TOLERANCE, "gradient of {name} differs by {error:.1e}");
            }
            assert_eq!(step.gradients.len(), expected.len());
        }
    }
    assert!(checked_files > 0, "no file with the losses of a training step");
}

impl Golden {
    /// Computes a training step on the recorded batch and random draws.
    fn train(
        &self,
        model: &Tdmpc2,
        config: &Tdmpc2Config,
        loss: &LossConfig,
        draws: &str,
        terminations: bool,
        shards: usize,
    ) -> Tdmpc2Step {
        // Reorders rows from clip-major to step-major.
        let step_major = |name: &str| {
            let [clips, steps, width] = self.tensor::<3>(name).dims();
            self.tensor::<3>(name).swap_dims(0, 1).reshape([steps * clips, width])
        };
        let [clips, steps, width] = self.tensor::<3>("i.action").dims();
        let horizon = steps - 1;
        let flat = |name: &str| self.tensor::<2>(name).swap_dims(0, 1).narrow(0, 0, horizon);
        let ended = flat("i.terminated");
        let batch = TrainBatch {
            observations: Observation {
                pixels: None,
                columns: config.column_encodings().map(|part| step_major(&format!("i.{}", part.column))).collect(),
            },
            actions: step_major("i.action").narrow(0, 0, horizon * clips).reshape([horizon, clips, width]),
            rewards: flat("i.reward"),
            terminated: if terminations { ended } else { ended.zeros_like() },
        };
        let pairs = |name: &str| {
            let pairs = &self.get(&format!("{draws}.{name}")).values;
            pairs.chunks(2).map(|pair| [pair[0] as usize, pair[1] as usize]).collect()
        };
        let draws = Draws {
            target: self.tensor(&format!("{draws}.target_noise")),
            policy: self.tensor(&format!("{draws}.policy_noise")),
            target_critics: pairs("target_critics"),
            policy_critics: pairs("policy_critics"),
            dropout: None,
        };
        step(model, &batch, loss, &draws, shards)
    }
}
