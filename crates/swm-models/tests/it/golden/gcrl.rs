//! Goal-conditioned models: heads of the published package (`gcrl-*`), and losses with all gradients (`gcbc-*`,
//! `gcivl-*`, `gciql-*`).

use super::{Golden, TOLERANCE, check, error, files, values};
use burn::module::Module;
use burn::tensor::Tensor;
use std::collections::BTreeMap;
use std::path::PathBuf;
use swm_core::Key;
use swm_data::GoalMixture;
use swm_models::gcrl::heads::{Critic, Head};
use swm_models::gcrl::loss::{self, ValueLoss};
use swm_models::gcrl::step::{Clips, Relabelled};
use swm_models::gcrl::transformer::{PatchGrid, Pool, TransformerConfig};
use swm_models::gcrl::{Gcbc, Gciql, Gcivl, GcrlConfig, import};
use swm_models::nn::{BackboneConfig, DropoutRng, Init, VitConfig, parameters};
use swm_models::train::{DatasetInfo, StepOutput};
use swm_models::weights::{self, Naming};
use swm_plan::ActionScale;

impl Golden {
    fn head(&self) -> TransformerConfig {
        TransformerConfig {
            depth: self.size("depth"),
            heads: self.size("heads"),
            dim_head: self.size("dim_head"),
            mlp: self.config.get("mlp_dim").map_or_else(|| self.size("mlp"), |_| self.size("mlp_dim")),
            dropout: 0.0,
            emb_dropout: 0.0,
        }
    }

    fn gcrl(&self) -> GcrlConfig {
        GcrlConfig {
            image: self.size("image"),
            pixel_mean: [0.5; 3],
            pixel_std: [0.5; 3],
            history: self.size("history"),
            frozen: false,
            weights: String::new(),
            encoder: BackboneConfig::Vit(VitConfig {
                patch: self.size("patch"),
                dim: self.size("dim"),
                depth: self.size("vit_layers"),
                heads: self.size("vit_heads"),
                mlp: self.size("vit_mlp"),
            }),
            head: self.head(),
            critic: self.size("critic_hidden"),
            metric: 0,
        }
    }

    /// Loads the published weights; checks that the module has exactly these weights.
    fn fill<M: Module>(&self, prefix: &str, module: M) -> M {
        let weights = self.group(prefix);
        let shapes = parameters::shapes(&module);
        for (name, shape) in &shapes {
            assert_eq!(
                weights.get(name).map(|weight| &weight.shape),
                Some(shape),
                "the shape of the published weight {name}"
            );
        }
        assert_eq!(shapes.len(), weights.len());
        parameters::load(module, &weights)
    }

    fn clips(&self) -> Clips {
        let actions: Tensor<3> = self.tensor("i.action");
        let [clips, _, dim] = actions.dims();
        let actions = actions.slice([0..clips, 0..self.size("history"), 0..dim]);
        Clips { frames: self.patches("i.pixels"), goal: self.patches("i.goal"), actions }
    }

    fn relabelled(&self) -> Relabelled {
        Relabelled { policy_goal: self.patches("i.actor_goal"), reached: self.tensor("i.reached") }
    }

    fn value_loss(&self) -> ValueLoss {
        let value = |name: &str| self.config[name].as_f64().expect(name) as f32;
        ValueLoss {
            discount: value("discount"),
            expectile: value("expectile"),
            temperature: value("temperature"),
            target: 0.995,
            goals: GoalMixture::default(),
            policy_goals: GoalMixture::FUTURE,
        }
    }

    /// Compares the recorded metrics and all gradients.
    fn compare(&self, output: &StepOutput) {
        for (name, actual) in &output.metrics {
            if self.tensors.contains_key(&format!("o.{name}")) {
                check(self, &format!("o.{name}"), &[*actual as f32]);
            }
        }
        let mut worst = (0.0, String::new());
        let expected = self.group("g.");
        let largest = expected.values().flat_map(|g| &g.values).fold(0.0f32, |m, v| m.max(v.abs()));
        for (name, gradient) in &expected {
            let actual = values(output.gradients.get(name).unwrap_or_else(|| panic!("a gradient of {name}")).clone());
            // A softmax cancels the bias of the keys, so its gradient is zero up to rounding; the error is relative
            // to the largest gradient of all parameters.
            let has_no_effect = name.ends_with(".key.bias");
            let error = error(&actual, &gradient.values, if has_no_effect { largest } else { 1e-6 });
            if error > worst.0 {
                worst = (error, name.clone());
            }
        }
        println!("worst gradient: {:.1e} ({})", worst.0, worst.1);
        assert!(worst.0 < TOLERANCE, "gradient of {} differs by {:.1e}", worst.1, worst.0);
        let unexpected: Vec<_> = output.gradients.keys().filter(|name| !expected.contains_key(*name)).collect();
        assert!(unexpected.is_empty(), "gradients that are not in the file: {unexpected:?}");
    }
}

#[test]
fn heads_and_expectile_losses_equal_the_reference() {
    for file in files("gcrl") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let init = Init::new(Key::new(0), &crate::device());
        let grid = PatchGrid {
            frames: golden.size("num_frames"),
            patches: golden.size("num_patches"),
            dim: golden.size("dim"),
        };
        let (frames, goal) = (golden.tensor("i.x"), golden.tensor("i.goal"));
        let policy = Head::new(&init, &golden.head(), grid, Pool::Attention, golden.size("out_dim"));
        let means = golden.fill("w.policy.", policy).forward(&frames, &goal, &mut DropoutRng::disabled());
        check(&golden, "o.policy", &values(means));
        let (action_dim, hidden) = (golden.size("action_dim"), golden.size("q_hidden_dim"));
        let critic = Critic::new(&init, &golden.head(), grid, Pool::Attention, action_dim, hidden);
        let critic = golden.fill("w.q.", critic);
        let action_values = critic.forward(&frames, golden.tensor("i.action"), &goal, &mut DropoutRng::disabled());
        check(&golden, "o.q", &values(action_values));
        for name in golden.tensors.keys().filter(|name| name.starts_with("o.expectile_")) {
            let tau = name.trim_start_matches("o.expectile_").parse().expect("an expectile in the tensor name");
            let loss = loss::expectile::<1>(golden.tensor("i.preds"), golden.tensor("i.targets"), tau);
            check(&golden, name, &values(loss));
        }
    }
}

#[test]
fn gcbc_losses_equal_the_reference() {
    for file in files("gcbc") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = Gcbc::init(&golden.gcrl(), golden.size("action_dim"), &Init::new(Key::new(0), &crate::device()));
        let model = golden.fill("w.", model);
        golden.compare(&model.losses(&golden.clips(), &mut DropoutRng::disabled(), true));
    }
}

#[test]
fn gcivl_losses_equal_the_reference() {
    for file in files("gcivl") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = Gcivl::init(&golden.gcrl(), golden.size("action_dim"), &Init::new(Key::new(0), &crate::device()));
        let model = golden.fill("w.", model);
        let (clips, relabelled, settings) = (golden.clips(), golden.relabelled(), golden.value_loss());
        golden.compare(&model.losses(&clips, &relabelled, &settings, &mut DropoutRng::disabled(), true));
    }
}

#[test]
fn gciql_losses_equal_the_reference() {
    for file in files("gciql") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let model = Gciql::init(&golden.gcrl(), golden.size("action_dim"), &Init::new(Key::new(0), &crate::device()));
        let model = golden.fill("w.", model);
        let (clips, relabelled, settings) = (golden.clips(), golden.relabelled(), golden.value_loss());
        golden.compare(&model.losses(&clips, &relabelled, &settings, &mut DropoutRng::disabled(), true));
    }
}

#[test]
fn gcivl_checkpoint_of_the_reference_round_trips() {
    let golden_folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let dataset_info = DatasetInfo { action: ActionScale::identity(2), columns: Default::default(), env: None };
    let checkpoint = import::import::<Gcivl>(&golden_folder.join("reference/gcivl"), dataset_info.clone())
        .expect("importing the reference checkpoint");
    let golden = Golden::read(&golden_folder.join("gcivl-small.safetensors"));
    let sizes = &checkpoint.config.model;
    assert_eq!((&sizes.head, &sizes.encoder), (&golden.head(), &golden.gcrl().encoder));
    assert_eq!((sizes.image, sizes.history, checkpoint.config.data.frameskip), (8, 3, 2));
    let actual = parameters::values(&checkpoint.model);
    assert_eq!(actual, golden.group("w."));

    // Exported weights have the names and shapes of the reference's class, without the target networks.
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    import::export(&checkpoint, folder.path(), Naming::Published).expect("exporting a checkpoint");
    let written = weights::read(&folder.path().join("weights.pt")).expect("reading the exported weights");
    let expected =
        weights::read(&golden_folder.join("reference/gcivl/weights.pt")).expect("reading the reference weights");
    let expected: BTreeMap<_, _> = expected
        .into_iter()
        .filter(|(name, _)| !name.contains(".teacher."))
        .map(|(name, weight)| (name.replace(".student.", "."), weight))
        .collect();
    assert_eq!(written, expected);
    let again =
        import::import::<Gcivl>(folder.path(), dataset_info.clone()).expect("importing the exported checkpoint");
    let again = parameters::values(&again.model);
    for (name, weight) in &again {
        assert_eq!(weight, &actual[&name.replace(".teacher.", ".student.")], "{name}");
    }

    // The checkpoint contains a policy but no critic, and does not fit another action dimension.
    let cloned = import::import::<Gcbc>(folder.path(), dataset_info.clone()).expect("importing the policy");
    assert_eq!(parameters::values(&cloned.model)["log_stds"], actual["log_stds"]);
    let message =
        import::import::<Gciql>(folder.path(), dataset_info).expect_err("a checkpoint without a critic").to_string();
    assert!(message.contains("critic_predictor"), "{message}");
    let dataset_info = DatasetInfo { action: ActionScale::identity(3), columns: Default::default(), env: None };
    let message =
        import::import::<Gcivl>(folder.path(), dataset_info).expect_err("another action dimension").to_string();
    assert!(message.contains("a divisor of 4"), "{message}");
}
