//! The names of the weights of a vision transformer.
//!
//! Published files and `transformers` up to version 4 use the parameter names of this crate. Version 5 renames weights
//! when it loads a file, so a state dict that version 5 saved has the newer names.

use crate::nn::parameters::Named;
use std::path::Path;
use swm_core::{Error, Result};

/// The names in a state dict.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Naming {
    /// `transformers` up to version 4, and published files.
    #[default]
    Published,
    /// `transformers` from version 5 on.
    Transformers5,
}

/// Parts of weight names in a ViT: the published part, then the part in version 5 of `transformers`.
const VIT: &[(&str, &str)] = &[
    ("encoder.layer.", "layers."),
    (".attention.attention.query.", ".attention.q_proj."),
    (".attention.attention.key.", ".attention.k_proj."),
    (".attention.attention.value.", ".attention.v_proj."),
    (".attention.output.dense.", ".attention.o_proj."),
    (".intermediate.dense.", ".mlp.fc1."),
    (".output.dense.", ".mlp.fc2."),
];

/// Parts of weight names in a DINOv2: the published part, then the part in version 5 of `transformers`.
const DINO: &[(&str, &str)] = &[
    (".attention.attention.query.", ".attention.q_proj."),
    (".attention.attention.key.", ".attention.k_proj."),
    (".attention.attention.value.", ".attention.v_proj."),
    (".attention.output.dense.", ".attention.o_proj."),
];

/// Returns the table of the transformer below `prefix`; a transformer with LayerScale weights is a DINOv2.
fn table<T>(weights: &Named<T>, prefix: &str) -> &'static [(&'static str, &'static str)] {
    let scaled = weights.keys().any(|name| name.starts_with(prefix) && name.contains(".layer_scale1."));
    if scaled { DINO } else { VIT }
}

/// Renames the weights of the file `path`, of the transformer below `prefix` (such as `encoder.`), to their published names; published
/// names are unchanged.
///
/// # Errors
/// When the file has a weight under both of its names.
pub fn to_published<T>(weights: Named<T>, prefix: &str, path: &Path) -> Result<Named<T>> {
    let table = table(&weights, prefix);
    let is_newer = |name: &String| name.starts_with(prefix) && name.contains(".attention.q_proj.");
    if !weights.keys().any(is_newer) {
        return Ok(weights);
    }
    let mut published = Named::new();
    for (name, weight) in weights {
        let renamed = renamed(&name, prefix, |name, (old, new)| name.replacen(new, old, 1), table);
        insert(&mut published, renamed, weight, (&name, path))?;
    }
    Ok(published)
}

/// Inserts a weight that the file at a path stores under another name.
///
/// # Errors
/// When the file has the weight under a second name.
pub fn insert<T>(weights: &mut Named<T>, name: String, weight: T, (stored, path): (&str, &Path)) -> Result<()> {
    if weights.contains_key(&name) {
        let problem = format!("it has the weight '{name}' under two names; one is '{stored}'");
        return Err(Error::corrupt(path, problem, "remove one of the two, and save the file again"));
    }
    weights.insert(name, weight);
    Ok(())
}

/// Renames the weights of the transformer below `prefix` from their published names to the names of `naming`.
pub fn to_naming<T>(weights: Named<T>, prefix: &str, naming: Naming) -> Named<T> {
    let table = table(&weights, prefix);
    match naming {
        Naming::Published => weights,
        Naming::Transformers5 => {
            let change = |name: String, (old, new): (&str, &str)| name.replacen(old, new, 1);
            weights.into_iter().map(|(name, weight)| (renamed(&name, prefix, change, table), weight)).collect()
        }
    }
}

/// Returns a name whose parts were changed if it is of the transformer below `prefix`.
fn renamed(
    name: &str,
    prefix: &str,
    change: impl Fn(String, (&str, &str)) -> String,
    table: &[(&str, &str)],
) -> String {
    match name.strip_prefix(prefix) {
        Some(rest) => format!("{prefix}{}", table.iter().fold(rest.to_owned(), |name, pair| change(name, *pair))),
        None => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(names: &[&str]) -> Named<()> {
        names.iter().map(|name| ((*name).to_owned(), ())).collect()
    }

    #[test]
    fn weight_names_round_trip_between_transformers_versions() {
        let families = [
            (
                ["e.encoder.layer.0.attention.attention.query.bias", "e.encoder.layer.0.attention.output.dense.bias"],
                ["e.encoder.layer.0.intermediate.dense.weight", "e.encoder.layer.0.output.dense.weight"],
                ["e.layers.0.attention.q_proj.bias", "e.layers.0.attention.o_proj.bias"],
                ["e.layers.0.mlp.fc1.weight", "e.layers.0.mlp.fc2.weight"],
            ),
            (
                ["e.encoder.layer.0.attention.attention.query.bias", "e.encoder.layer.0.attention.output.dense.bias"],
                ["e.encoder.layer.0.mlp.fc1.weight", "e.encoder.layer.0.layer_scale1.lambda1"],
                ["e.encoder.layer.0.attention.q_proj.bias", "e.encoder.layer.0.attention.o_proj.bias"],
                ["e.encoder.layer.0.mlp.fc1.weight", "e.encoder.layer.0.layer_scale1.lambda1"],
            ),
        ];
        for (a, b, c, d) in families {
            // Weights outside of the transformer keep their names.
            let old = set(&[&a[..], &b[..], &["predictor.mlp.fc1.weight"]].concat());
            let new = set(&[&c[..], &d[..], &["predictor.mlp.fc1.weight"]].concat());
            assert_eq!(to_naming(old.clone(), "e.", Naming::Transformers5), new);
            let file = Path::new("weights.pt");
            assert_eq!(to_published(new.clone(), "e.", file).expect("newer names"), old);
            assert_eq!(to_published(old.clone(), "e.", file).expect("published names"), old);
            let both = old.into_iter().chain(new).collect();
            let error = to_published(both, "e.", file).expect_err("two names of one weight").to_string();
            assert!(error.contains("under two names"), "{error}");
        }
    }
}
