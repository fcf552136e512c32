//! DINO-WM: predictor, frames, rollouts, losses and gradients.

use super::{Golden, check, files, values};
use burn::tensor::Tensor;
use swm_core::Key;
use swm_models::dino_wm::step::{TrainBatch, step};
use swm_models::dino_wm::{ColumnConfig, DinoWm, DinoWmConfig, FramePredictor, FramePredictorConfig};
use swm_models::nn::parameters::{self, HostTensor, Named};
use swm_models::nn::{BackboneConfig, DinoConfig, DropoutRng, Init};

/// The published weights without the attention masks, which [`FramePredictor`] computes and does not load.
fn without_masks(weights: Named<HostTensor>) -> Named<HostTensor> {
    weights.into_iter().filter(|(name, weight)| !(name.ends_with(".0.bias") && weight.shape.len() == 4)).collect()
}

#[test]
fn predictor_equals_the_reference() {
    for file in files("dino-wm-predictor") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let size = |name| golden.size(name);
        let config = FramePredictorConfig {
            history: size("num_frames"),
            depth: size("depth"),
            heads: size("heads"),
            dim_head: size("dim_head"),
            mlp: size("mlp_dim"),
            dropout: 0.0,
            emb_dropout: 0.0,
        };
        let predictor: FramePredictor =
            config.init(&Init::new(Key::new(0), &crate::device()), size("num_patches"), size("dim"));
        let weights = without_masks(golden.group("w."));
        let published: Named<Vec<usize>> =
            weights.iter().map(|(name, weight)| (name.clone(), weight.shape.clone())).collect();
        assert_eq!(parameters::shapes(&predictor), published, "names and shapes of the published weights");
        let predictor = parameters::load(predictor, &weights);
        let x = golden.tensor::<3>("i.x");
        check(&golden, "o.y", &values(predictor.forward(x.clone(), &mut DropoutRng::disabled())));
        let [windows, tokens, dim] = x.dims();
        let two_frames = x.slice([0..windows, 0..tokens - size("num_patches"), 0..dim]);
        check(&golden, "o.y_two_frames", &values(predictor.forward(two_frames, &mut DropoutRng::disabled())));
    }
}

impl Golden {
    /// Name, elements per frame and embedding dimension of every column.
    fn columns(&self) -> Vec<(String, usize, usize)> {
        serde_json::from_value(self.config["columns"].clone()).expect("columns")
    }

    fn dino_wm_config(&self) -> DinoWmConfig {
        let size = |name| self.size(name);
        DinoWmConfig {
            image: size("image"),
            pixel_mean: [0.0; 3],
            pixel_std: [1.0; 3],
            weights: String::new(),
            encoder: BackboneConfig::Dinov2(DinoConfig {
                patch: size("patch"),
                dim: size("dim"),
                depth: size("vit_layers"),
                heads: size("vit_heads"),
                mlp: size("vit_mlp"),
                grid: size("grid"),
                registers: 0,
            }),
            columns: self.columns().into_iter().map(|(name, _, dim)| ColumnConfig { name, dim }).collect(),
            predictor: FramePredictorConfig {
                history: size("history"),
                depth: size("depth"),
                heads: size("heads"),
                dim_head: size("dim_head"),
                mlp: size("mlp"),
                dropout: 0.0,
                emb_dropout: 0.0,
            },
            decoder: 0,
        }
    }

    fn dino_wm(&self) -> DinoWm {
        let dims: Vec<usize> = self.columns().iter().map(|(_, dim, _)| *dim).collect();
        let model = DinoWm::init(&self.dino_wm_config(), &dims, &Init::new(Key::new(0), &crate::device()));
        let weights = without_masks(self.group("w."));
        let published: Named<Vec<usize>> =
            weights.iter().map(|(name, weight)| (name.clone(), weight.shape.clone())).collect();
        assert_eq!(parameters::shapes(&model), published, "names and shapes of the published weights");
        parameters::load(model, &weights)
    }
}

#[test]
fn embeddings_losses_gradients_and_rollouts_equal_the_reference() {
    for file in files("dino-wm-model") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = golden.dino_wm();
        let columns: Vec<Tensor<3>> =
            golden.columns().iter().map(|(name, ..)| golden.tensor(&format!("i.{name}"))).collect();
        let [clips, steps, _] = columns[0].dims();
        let encode = |name: &str, [clips, steps]: [usize; 2]| {
            let features = model.backbone.patches(golden.patches(name));
            let [_, patches, width] = features.dims();
            features.reshape([clips, steps, patches, width])
        };
        let frames = model.embed(encode("i.pixels", [clips, steps]), &columns);
        check(&golden, "o.emb", &values(frames.clone()));
        let [_, _, patches, dim] = frames.dims();
        let window = frames.clone().slice([0..clips, 0..golden.size("history"), 0..patches, 0..dim]);
        check(&golden, "o.pred", &values(model.predict(window, &mut DropoutRng::disabled())));

        let batch = TrainBatch { patches: golden.patches("i.pixels"), columns };
        let found = step(&model, &batch, None);
        for (name, value) in &found.losses {
            let name = match *name {
                "prediction" => "loss".to_owned(),
                "loss" => continue,
                part => format!("{part}_loss"),
            };
            check(&golden, &format!("o.{name}"), &[*value as f32]);
        }
        assert_eq!(found.losses.len(), 4);
        golden.check_gradients(&found.gradients, &[]);

        let [samples, _, _] = golden.tensor::<3>("i.candidates").dims();
        let start = frames.slice([0..1, 0..1, 0..patches, 0..dim]).expand([samples, 1, patches, dim]);
        let rollout = model.rollout(start, golden.tensor("i.candidates"));
        let expected = golden.get("o.rollout");
        // The action part of the last frame has no meaning; both implementations return the predictor's output for it.
        assert_eq!(expected.shape, rollout.dims());
        check(&golden, "o.rollout", &values(rollout));
    }
}
