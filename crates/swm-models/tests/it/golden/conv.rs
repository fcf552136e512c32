//! The convolutional encoder: features with running and with batch statistics, gradients, updated running statistics.

use super::{Golden, check, files, values};
use burn::module::Module;
use swm_core::Key;
use swm_models::nn::{Conv, ConvConfig, Init, conv, parameters};

#[test]
fn conv_features_statistics_and_gradients_equal_pytorch() {
    for file in files("conv") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let config: ConvConfig = {
            let channels = golden.config["channels"].as_array().expect("a list of channels");
            let channels = channels.iter().map(|count| count.as_u64().expect("a number of channels") as usize);
            ConvConfig { channels: channels.collect(), hidden: golden.size("hidden"), dim: golden.size("dim") }
        };
        let model = config.init(&Init::new(Key::new(0), &crate::device()), golden.size("image"));
        let weights = golden.group("w.");
        let published = weights.iter().map(|(name, weight)| (name.clone(), weight.shape.clone())).collect();
        assert_eq!(parameters::shapes(&model), published, "names and shapes of PyTorch's weights");
        let mut model: Conv = parameters::load(model, &weights);
        check(&golden, "o.eval", &values(model.forward(golden.patches("i.pixels"))));

        let trained = model.clone().train();
        let (features, statistics) = trained.forward_train(golden.patches("i.pixels").autodiff());
        check(&golden, "o.train", &values(features.clone().inner()));
        let gradients = parameters::gradients(&trained, &features.square().mean().backward());
        golden.check_gradients(&gradients, &[]);

        let mut buffers = parameters::Named::new();
        conv::store(statistics, "encoder", &mut buffers);
        model.track("encoder", &mut buffers);
        assert!(buffers.is_empty(), "statistics that no module has taken: {:?}", buffers.keys());
        let tracked = parameters::values(&model);
        for name in golden.group("s.").keys() {
            check(&golden, &format!("s.{name}"), &tracked[name].values);
        }
    }
}
