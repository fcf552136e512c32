//! PLDM: outputs, rollouts, costs, every term of the loss and gradients.

use super::{Golden, TOLERANCE, check, error, files, values};
use swm_core::Key;
use swm_models::lewm::step::TrainBatch;
use swm_models::lewm::{EncoderConfig, LewmConfig, Rollout};
use swm_models::nn::parameters::{self, Named};
use swm_models::nn::{Init, PredictorConfig, VitConfig};
use swm_models::pldm::step::step;
use swm_models::pldm::{Pldm, PldmLoss, Terms};

#[test]
fn loss_terms_equal_the_reference() {
    for file in files("pldm-losses") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let z = golden.tensor::<3>("i.z").autodiff().require_grad();
        let Terms { std, std_t, cov, cov_t, temp_align, temp_straight } = Terms::of(z.clone());
        let temp_straight = temp_straight.expect("clips of more than two frames");
        let idm = (golden.tensor::<3>("i.a_pred") - golden.tensor::<3>("i.a_target")).square().mean();
        check(&golden, "o.idm_loss", &values(idm));
        let terms = [
            ("o.std_loss", &std),
            ("o.std_t_loss", &std_t),
            ("o.cov_loss", &cov),
            ("o.cov_t_loss", &cov_t),
            ("o.temp_align_loss", &temp_align),
            ("o.straightening", &temp_straight),
        ];
        for (name, term) in terms {
            check(&golden, name, &values(term.clone().inner()));
        }
        // The recorded gradient is the gradient of the sum of all terms except inverse dynamics, which does not depend
        // on `z`.
        let mut all = (std + std_t + cov + cov_t + temp_align + temp_straight).backward();
        check(&golden, "g.z_of_sum", &values(z.grad_remove(&mut all).expect("a gradient")));
    }
}

impl Golden {
    fn world_model_config(&self) -> LewmConfig {
        LewmConfig {
            image: self.size("image"),
            pixel_mean: [0.0; 3],
            pixel_std: [1.0; 3],
            latent: self.size("latent"),
            smoothed: 0,
            projector: self.size("proj_hidden"),
            encoder: EncoderConfig::Vit(VitConfig {
                patch: self.size("patch"),
                dim: self.size("dim"),
                depth: self.size("vit_layers"),
                heads: self.size("vit_heads"),
                mlp: self.size("vit_mlp"),
            }),
            predictor: PredictorConfig {
                history: self.size("history"),
                dim: self.size("dim"),
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

    fn pldm(&self) -> Pldm {
        let (action_dim, hidden) = (self.size("action_dim"), self.size("idm_hidden"));
        let model =
            Pldm::init(&self.world_model_config(), action_dim, hidden, &Init::new(Key::new(0), &crate::device()));
        let weights = self.group("w.");
        let published: Named<Vec<usize>> =
            weights.iter().map(|(name, weight)| (name.clone(), weight.shape.clone())).collect();
        assert_eq!(parameters::shapes(&model), published, "names and shapes of the published weights");
        parameters::load(model, &weights)
    }
}

#[test]
fn latents_predictions_rollouts_and_costs_equal_the_reference() {
    for file in files("pldm-model") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = golden.pldm().model;
        let ([clips, steps, action_dim], latent) = (golden.tensor::<3>("i.action").dims(), golden.size("latent"));
        let latents = model.encode(golden.patches("i.pixels")).reshape([clips, steps, latent]);
        check(&golden, "o.eval.emb", &values(latents.clone()));
        let window = [0..clips, 0..golden.size("history"), 0..latent];
        let conditions = model.embed_actions(golden.tensor("i.action")).slice(window.clone());
        check(&golden, "o.eval.pred", &values(model.predict(latents.clone().slice(window), conditions)));

        let [samples, horizon, _] = golden.tensor::<3>("i.candidates").dims();
        let start = latents.slice([0..1, 0..1, 0..latent]);
        let candidates = golden.tensor("i.candidates");
        let rollout = model.rollout(start.clone().expand([samples, 1, latent]), candidates.clone());
        check(&golden, "o.rollout", &values(rollout.clone()));
        let goal = model.encode(golden.patches("i.goal")).reshape([1, 1, latent]);
        let last = rollout.slice([0..samples, horizon..horizon + 1, 0..latent]);
        check(&golden, "o.cost", &values((last - goal).square().sum_dim(2)));
        // Planning uses the CPU rollout.
        let fast = Rollout::new(&model).run(&values(start), &values(candidates), samples, horizon);
        let expected = &golden.get("o.rollout").values;
        for (time, latents) in fast.iter().enumerate() {
            for (sample, actual) in latents.chunks(latent).enumerate() {
                let expected = &expected[(sample * (horizon + 1) + time) * latent..][..latent];
                assert!(error(actual, expected, 1.0) < TOLERANCE / 10.0, "CPU rollout, step {time}");
            }
        }
        assert_eq!(action_dim, golden.size("action_dim"));
    }
}

#[test]
fn training_losses_and_gradients_equal_the_reference() {
    for file in files("pldm-model") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let weight = |name: &str| golden.config["weights"][name].as_f64().expect(name) as f32;
        let weights = PldmLoss {
            std: weight("std"),
            std_t: weight("std_t"),
            cov: weight("cov"),
            cov_t: weight("cov_t"),
            temp_align: weight("temp_align"),
            idm: weight("idm"),
            temp_straight: weight("temp_straight"),
            idm_hidden: golden.size("idm_hidden"),
        };
        for shards in [1, 4] {
            let batch = TrainBatch { patches: golden.patches("i.pixels"), actions: golden.tensor("i.action") };
            let output = step(&golden.pldm(), &batch, &weights, shards, None);
            check(&golden, "o.train.emb", &output.latents);
            for (name, value) in &output.losses {
                let name = match *name {
                    "loss" => "loss".to_owned(),
                    "prediction" => "pred_loss".to_owned(),
                    term => format!("{term}_loss"),
                };
                check(&golden, &format!("o.train.{name}"), &[*value as f32]);
            }
            golden.check_gradients(
                &output.gradients,
                &[
                    "projector.net.0.bias",
                    "pred_proj.net.0.bias",
                    ".key.bias",
                    "encoder.layernorm.bias",
                    "predictor.transformer.norm.bias",
                    "predictor.transformer.output_proj.bias",
                ],
            );
        }
    }
}
