//! The names of the weights of a vision transformer.
//!
//! Published files and `transformers` up to version 4 use the parameter names of this crate. Version 5 renames weights
//! when it loads a file, so a state dict that version 5 saved has the newer names.

use crate::nn::parameters::Named;

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

/// Renames the weights of the transformer below `prefix` (such as `encoder.`) to their published names; published names
/// are unchanged.
pub fn to_published<T>(weights: Named<T>, prefix: &str) -> Named<T> {
    let table = table(&weights, prefix);
    let is_newer = |name: &String| name.starts_with(prefix) && name.contains(".attention.q_proj.");
    if !weights.keys().any(is_newer) {
        return weights;
    }
    rename(weights, prefix, |name, (old, new)| name.replacen(new, old, 1), table)
}

/// Renames the weights of the transformer below `prefix` from their published names to the names of `naming`.
pub fn to_naming<T>(weights: Named<T>, prefix: &str, naming: Naming) -> Named<T> {
    let table = table(&weights, prefix);
    match naming {
        Naming::Published => weights,
        Naming::Transformers5 => rename(weights, prefix, |name, (old, new)| name.replacen(old, new, 1), table),
    }
}

fn rename<T>(
    weights: Named<T>,
    prefix: &str,
    change: impl Fn(String, (&str, &str)) -> String,
    table: &[(&str, &str)],
) -> Named<T> {
    weights
        .into_iter()
        .map(|(name, tensor)| match name.strip_prefix(prefix) {
            Some(rest) => {
                let rest = table.iter().fold(rest.to_owned(), |name, pair| change(name, *pair));
                (format!("{prefix}{rest}"), tensor)
            }
            None => (name, tensor),
        })
        .collect()
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
            assert_eq!(to_published(new, "e."), old);
            assert_eq!(to_published(old.clone(), "e."), old);
        }
    }
}
