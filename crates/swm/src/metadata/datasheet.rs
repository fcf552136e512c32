//! [`datasheet`]: a datasheet (Gebru et al., "Datasheets for datasets", 2021) as Markdown.

use super::{Described, DescribedFile, Stated};
use crate::cli::study::escape_markdown as cell;
use std::fmt::Write as _;
use swm_core::Manifest;

/// What a question is answered with that only the author can answer.
const NOT_STATED: &str = "*Not stated.*";
/// The most files with a row.
const FILES: usize = 50;

/// Returns the datasheet of a dataset or a capsule. Questions that its files do not answer are marked as not stated.
pub fn datasheet(described: &Described) -> String {
    let Described { name, summary, stated, files, content, columns, size, manifest, measured } = described;
    let Stated { licence, author, url } = stated;
    let is_data = size.is_some();
    let or_none = |text: &Option<String>| text.as_deref().map_or(NOT_STATED.to_owned(), cell);
    let mut text = format!("# Datasheet: {}\n\n{}\n\n## Motivation\n\n", cell(name), cell(summary));
    let _ = write!(text, "- For what purpose: {NOT_STATED}\n- Made by: {}\n\n## Composition\n\n", or_none(author));
    if let Some([episodes, rows]) = size {
        let _ = write!(
            text,
            "{episodes} episodes, {rows} rows. Row t holds the observation at t and the action taken from it.\n\n"
        );
        text += "| column | type | shape of a row |\n| --- | --- | --- |\n";
        for column in columns {
            let _ = writeln!(text, "| {} | {} | {:?} |", cell(&column.name), column.dtype.name(), column.shape);
        }
        text += "\nThe trajectories are simulated: there are no people in them, and no personal data.\n";
    }
    for (name, value) in measured {
        let _ = writeln!(text, "- {}: {}", cell(name), cell(value));
    }
    let _ = write!(text, "\n## {}\n\n", if is_data { "Collection process" } else { "Training" });
    text += &manifest.as_ref().map_or("No manifest: the provenance is unknown.\n".to_owned(), provenance);
    text += "\n## Preprocessing and labelling\n\n";
    text +=
        if is_data { "None beyond the encoding of frames: values are those of the simulator.\n" } else { NOT_STATED };
    let _ = write!(
        text,
        "\n\n## Uses\n\n{NOT_STATED}\n\n## Distribution\n\n- Licence: {}\n- Published at: {}\n",
        or_none(licence),
        or_none(url)
    );
    let _ = write!(
        text,
        "- Hash of the content (BLAKE3): `{content}`\n\n| file | bytes | SHA-256 |\n| --- | --- | --- |\n"
    );
    for DescribedFile { path, bytes, sha256 } in files.iter().take(FILES) {
        let _ = writeln!(text, "| {} | {bytes} | `{sha256}` |", cell(path));
    }
    if files.len() > FILES {
        let _ = writeln!(text, "\n{} more files are in the Croissant metadata.", files.len() - FILES);
    }
    let _ = write!(text, "\n## Maintenance\n\n{NOT_STATED}\n");
    text
}

/// How a dataset or a model was made.
fn provenance(manifest: &Manifest) -> String {
    let mut text = String::new();
    let _ = writeln!(
        text,
        "Made by `{}` of stable-worldmodel {} with the seed {} on {}.\n",
        cell(&manifest.kind),
        cell(&manifest.swm_version),
        manifest.seed,
        cell(&manifest.device)
    );
    text += "| setting | value |\n| --- | --- |\n";
    let settings = manifest.config.as_object().into_iter().flatten().filter(|(_, value)| !value.is_null());
    let settings =
        settings.map(|(name, value)| (name, value.as_str().map_or_else(|| value.to_string(), str::to_owned)));
    let versions = manifest.libraries.iter().map(|(name, value)| (name, value.clone()));
    let hashes = manifest.hashes.iter().map(|(name, value)| (name, format!("BLAKE3 {value}")));
    for (name, value) in settings.chain(versions).chain(hashes) {
        let _ = writeln!(text, "| {} | {} |", cell(name), cell(&value));
    }
    text
}
