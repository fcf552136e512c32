//! LeWM: outputs, rollouts, costs, losses and gradients.

use super::{Golden, TOLERANCE, check, error, files, values};
use burn::tensor::Tensor;
use swm_core::Key;
use swm_models::lewm::host_encoder::HostEncoder;
use swm_models::lewm::step::{SigregConfig, TrainBatch, step};
use swm_models::lewm::{EncoderConfig, Lewm, LewmConfig, Rollout};
use swm_models::nn::parameters;
use swm_models::nn::{Init, PredictorConfig, VitConfig};

impl Golden {
    fn config(&self) -> LewmConfig {
        let dim = self.size("dim");
        LewmConfig {
            image: self.size("image"),
            pixel_mean: [0.0; 3],
            pixel_std: [1.0; 3],
            latent: dim,
            smoothed: 0,
            projector: self.size("proj_hidden"),
            encoder: EncoderConfig::Vit(VitConfig {
                patch: self.size("patch"),
                dim,
                depth: self.size("vit_layers"),
                heads: self.size("vit_heads"),
                mlp: self.size("vit_mlp"),
            }),
            predictor: PredictorConfig {
                history: self.size("history"),
                dim,
                depth: self.size("depth"),
                heads: self.size("heads"),
                dim_head: self.size("dim_head"),
                mlp: self.size("mlp"),
                dropout: 0.0,
                emb_dropout: 0.0,
            },
            decoder: None,
        }
    }

    fn model(&self) -> Lewm {
        let model = Lewm::init(&self.config(), self.size("action_dim"), &Init::new(Key::new(0), &crate::device()));
        let weights = self.group("w.");
        for (name, shape) in parameters::shapes(&model) {
            assert_eq!(weights.get(&name).map(|w| &w.shape), Some(&shape), "the shape of the published weight {name}");
        }
        parameters::load(model, &weights)
    }
}

#[test]
fn latents_predictions_rollouts_and_costs_equal_the_reference() {
    for file in files("lewm") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = golden.model();
        let [clips, steps, action_dim] = golden.tensor::<3>("i.action").dims();
        let dim = golden.size("dim");
        let latents = model.encode(golden.patches("i.pixels")).reshape([clips, steps, dim]);
        check(&golden, "o.eval.emb", &values(latents.clone()));
        // The CPU encoder encodes one image at a time.
        let fast = HostEncoder::new(&model, &golden.config()).expect("creating the CPU encoder");
        let images = golden.patches("i.pixels");
        let size = images.dims()[1] * images.dims()[2];
        let fast: Vec<f32> = values(images).chunks(size).flat_map(|patches| fast.encode(patches)).collect();
        check(&golden, "o.eval.emb", &fast);
        let conditions = model.embed_actions(golden.tensor("i.action"));
        check(&golden, "o.eval.act_emb", &values(conditions.clone()));
        let window = [0..clips, 0..golden.get("o.eval.pred").shape[1], 0..dim];
        let predictions = model.predict(latents.clone().slice(window.clone()), conditions.slice(window));
        check(&golden, "o.eval.pred", &values(predictions));

        let [envs, samples, horizon, _] = golden.tensor::<4>("i.candidates").dims();
        let candidates = golden.tensor::<4>("i.candidates").reshape([envs * samples, horizon, action_dim]);
        let goal = model.encode(golden.patches("i.goal")).reshape([envs, 1, dim]).expand([envs, samples, dim]);
        for history in [1, 3] {
            // The start of every candidate: the first frames of a clip and the actions between these frames.
            let repeat = |x: Tensor<3>, length: usize, width: usize| {
                let x: Tensor<4> = x.slice([0..envs, 0..length, 0..width]).unsqueeze_dim(1);
                x.expand([envs, samples, length, width]).reshape([envs * samples, length, width])
            };
            let mut actions = candidates.clone();
            if history > 1 {
                actions = Tensor::cat(vec![repeat(golden.tensor("i.action"), history - 1, action_dim), actions], 1);
            }
            let rollout = model.rollout(repeat(latents.clone(), history, dim), actions.clone());
            let [_, length, _] = rollout.dims();
            // The CPU rollout computes one environment at a time.
            let fast = Rollout::new(&model);
            let steps = length - 1;
            let values_of = |x: Tensor<3>, env: usize| {
                let [_, b, c] = x.dims();
                values(x.slice([env * samples..(env + 1) * samples, 0..b, 0..c]))
            };
            for env in 0..envs {
                let start = values(latents.clone().slice([env..env + 1, 0..history, 0..dim]));
                let all = fast.run(&start, &values_of(actions.clone(), env), samples, steps);
                let expected = &golden.get(&format!("o.rollout.h{history}")).values[env * samples * length * dim..];
                for (time, latents) in all.iter().enumerate() {
                    for (sample, latent) in latents.chunks(dim).enumerate() {
                        let expected = &expected[(sample * length + time) * dim..][..dim];
                        let error = error(latent, expected, 1.0);
                        assert!(
                            error < TOLERANCE / 10.0,
                            "CPU rollout with history {history}, step {time}: {error:.1e}"
                        );
                    }
                }
            }
            check(&golden, &format!("o.rollout.h{history}"), &values(rollout.clone()));
            let last = rollout.slice([0..envs * samples, length - 1..length, 0..dim]).reshape([envs, samples, dim]);
            let cost: Tensor<3> = (last - goal.clone()).square().sum_dim(2);
            check(&golden, &format!("o.cost.h{history}"), &values(cost));
        }
    }
}

#[test]
fn training_losses_and_gradients_equal_the_reference() {
    for file in files("lewm") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let projections = golden.tensor::<2>("i.sigreg_projections");
        let sigreg = SigregConfig {
            weight: golden.config["sigreg_weight"].as_f64().expect("a weight") as f32,
            directions: golden.size("num_proj"),
            knots: golden.size("knots"),
            temp_straight: 0.0,
        };
        for shards in [1, 3] {
            let batch = TrainBatch { patches: golden.patches("i.pixels"), actions: golden.tensor("i.action") };
            let output = step(&golden.model(), &batch, &sigreg, &values(projections.clone().transpose()), shards, None);
            check(&golden, "o.train.emb", &output.latents);
            check(&golden, "o.train.loss", &[output.losses.total as f32]);
            check(&golden, "o.train.pred_loss", &[output.losses.prediction as f32]);
            check(&golden, "o.train.sigreg_loss", &[output.losses.sigreg as f32]);
            golden.check_gradients(
                &output.gradients,
                &[
                    "projector.net.0.bias",
                    "pred_proj.net.0.bias",
                    ".key.bias",
                    "encoder.layernorm.bias",
                    "predictor.transformer.norm.bias",
                ],
            );
        }
    }
}
