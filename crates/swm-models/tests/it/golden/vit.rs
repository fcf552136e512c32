//! Backbones: tokens and gradients, for images of the original size and of another size.

use super::{Golden, check, files, values};
use burn::module::Module;
use burn::tensor::Tensor;
use swm_core::Key;
use swm_models::nn::{Dino, DinoConfig, Init, Vit, VitConfig, parameters};

/// Compares the tokens and gradients of a module with the recorded tokens and gradients.
fn compare<M: Module>(golden: &Golden, module: M, tokens: impl Fn(&M, Tensor<3>) -> Tensor<3>) {
    let weights = golden.group("w.");
    let shapes = parameters::shapes(&module);
    let published = weights.iter().map(|(name, weight)| (name.clone(), weight.shape.clone())).collect();
    assert_eq!(shapes, published, "names and shapes of the published weights");
    let module = parameters::load(module, &weights);
    check(golden, "o.tokens", &values(tokens(&module, golden.patches("i.pixels"))));
    let patches = |side: usize| golden.patches_of_side("i.other", side);
    let module = module.train();
    let other = tokens(&module, patches(golden.size("other")).autodiff());
    check(golden, "o.other", &values(other.clone().inner()));
    let all = other.square().mean().backward();
    let gradients = parameters::gradients(&module, &all);
    golden.check_gradients(&gradients, &[".key.bias"]);
}

#[test]
fn vit_tokens_equal_the_reference() {
    for file in files("vit") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let size = |name| golden.size(name);
        let config = VitConfig {
            patch: size("patch"),
            dim: size("dim"),
            depth: size("depth"),
            heads: size("heads"),
            mlp: size("mlp"),
        };
        let vit = config.init(&Init::new(Key::new(0), &crate::device()), size("image"));
        compare(&golden, vit, Vit::tokens);
    }
}

#[test]
fn dinov2_tokens_equal_the_reference() {
    for file in files("dinov2") {
        println!("{}", file.display());
        let golden = Golden::read(&file);
        let size = |name| golden.size(name);
        let config = DinoConfig {
            patch: size("patch"),
            dim: size("dim"),
            depth: size("depth"),
            heads: size("heads"),
            mlp: size("mlp"),
            grid: size("grid"),
            registers: size("registers"),
        };
        compare(&golden, config.init(&Init::new(Key::new(0), &crate::device())), Dino::tokens);
    }
}
