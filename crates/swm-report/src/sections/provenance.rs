//! The section of provenance: commands, versions, hashes and configuration of every results file.

use crate::limits;
use crate::text::{escape, shorten};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Manifest, Results};

/// Writes the section; `command` replaces the commands in the manifests.
pub(crate) fn write(html: &mut String, results: &[(PathBuf, Results)], command: Option<&str>) {
    html.push_str("<section>\n<h2>Provenance</h2>\n");
    if let Some(command) = command {
        let command = escape(&shorten(command, limits::CONFIG_CHARS));
        let _ = write!(html, "<p>The command that reproduces these results:</p>\n<pre>{command}</pre>\n");
    }
    let start = html.len();
    for (i, (path, result)) in results.iter().enumerate() {
        if html.len() - start > limits::PROVENANCE_BYTES {
            let _ = writeln!(html, "<p class=\"note\">{} more files are left out.</p>", results.len() - i);
            break;
        }
        let number = if results.len() > 1 { format!("[{}] ", i + 1) } else { String::new() };
        let _ =
            writeln!(html, "<h3>{number}<code>{}</code></h3>", escape(&shorten(&short_path(path), limits::TEXT_CHARS)));
        let config = &result.manifest.config;
        let recorded = config.get("command").and_then(serde_json::Value::as_str).map(str::to_owned);
        // `swm reproduce` requires a request with a version.
        let reproduce = config.get("version").map(|_| format!("swm reproduce {}", short_path(path)));
        match (recorded.or(reproduce), command) {
            (Some(command), None) => {
                let _ = write!(
                    html,
                    "<p>The command that reproduces the results and lists all differences:</p>\n<pre>{}</pre>\n",
                    escape(&shorten(&command, limits::CONFIG_CHARS))
                );
            }
            (None, None) => html.push_str(
                "<p class=\"note\">The configuration below, with these versions and hashes, determines all results except \
                 times.</p>\n",
            ),
            (_, Some(_)) => {}
        }
        manifest(html, &result.manifest);
    }
    html.push_str("</section>\n");
}

/// The names of a file and its folder: they distinguish files without revealing the full path.
fn short_path(path: &Path) -> String {
    let parts: Vec<_> = path.components().rev().take(2).collect();
    parts.into_iter().rev().collect::<PathBuf>().display().to_string()
}

fn manifest(html: &mut String, manifest: &Manifest) {
    html.push_str("<dl>\n");
    let mut entry = |name: &str, value: &str, class: &str| {
        let [name, value] = [name, value].map(|words| escape(&shorten(words, limits::TEXT_CHARS)));
        let _ = writeln!(html, "<div><dt>{name}</dt><dd{class}>{value}</dd></div>");
    };
    entry("kind", &manifest.kind, "");
    entry("stable-worldmodel", &manifest.swm_version, "");
    entry("seed", &manifest.seed.to_string(), "");
    entry("device", &manifest.device, "");
    for (library, version) in manifest.libraries.iter().take(limits::ENTRIES) {
        entry(library, version, "");
    }
    for (what, hash) in manifest.hashes.iter().take(limits::ENTRIES) {
        entry(&format!("{what} (BLAKE3)"), hash, " class=\"hash\"");
    }
    html.push_str("</dl>\n");
    if !manifest.config.is_null() {
        let config = serde_json::to_string_pretty(&manifest.config).unwrap_or_else(|_| manifest.config.to_string());
        let config = escape(&shorten(&config, limits::CONFIG_CHARS));
        let _ = write!(html, "<details>\n<summary>Configuration</summary>\n<pre>{config}</pre>\n</details>\n");
    }
}
