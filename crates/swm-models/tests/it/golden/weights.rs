//! Files of weights that PyTorch wrote, and state dicts written for PyTorch.

use std::path::{Path, PathBuf};
use swm_models::nn::parameters::{HostTensor, Named};
use swm_models::weights;

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name)
}

#[test]
fn weight_files_of_all_formats_have_equal_content() {
    let expected =
        weights::read(&file("weights-single.safetensors")).expect("reading the file of single-precision weights");
    assert_eq!(expected["norm.num_batches_tracked"], HostTensor { shape: vec![], values: vec![7.0] });
    for name in ["weights-zip.pt", "weights-legacy.pth", "weights-training.ckpt", "weights-same.safetensors"] {
        assert_eq!(weights::read(&file(name)).expect(name), expected, "{name}");
    }
}

#[test]
fn state_dicts_round_trip() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("weights.pt");
    let tensor = |shape: &[usize], first: f32| HostTensor {
        shape: shape.to_vec(),
        values: (0..shape.iter().product()).map(|i| first + i as f32).collect(),
    };
    let state: Named<HostTensor> = [
        ("a.weight", tensor(&[3, 2, 1], 0.5)),
        ("a.bias", tensor(&[70], -3.0)),
        ("norm.num_batches_tracked", tensor(&[], 300.0)),
        ("ünïcode", tensor(&[0], 0.0)),
    ]
    .into_iter()
    .map(|(name, tensor)| (name.to_owned(), tensor))
    .collect();
    weights::torch::write(&path, &state).expect("writing a file");
    assert_eq!(weights::read(&path).expect("reading the written state dict"), state);
}

#[test]
fn invalid_weight_files_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let message = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("writing a file");
        weights::read(&path).expect_err("an invalid file").to_string()
    };
    assert!(message("weights.txt", b"").contains(".safetensors, .pt"));
    assert!(message("weights.pt", b"not a pickle").contains("torch.save"));
    assert!(message("weights.safetensors", b"short").contains("save the state dict again"));
    // A pickle that calls a program is refused, not executed.
    let attack = b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.";
    assert!(message("attack.pt", attack).contains("torch.save"), "{}", message("attack.pt", attack));
    let missing = weights::read(&folder.path().join("none.pt")).expect_err("a missing file").to_string();
    assert!(missing.contains("none.pt: opening the file"), "{missing}");
    // A truncated file is refused.
    let valid_file = std::fs::read(file("weights-zip.pt")).expect("reading weights-zip.pt");
    assert!(message("cut.pt", &valid_file[..valid_file.len() / 2]).contains("torch.save"));
}
