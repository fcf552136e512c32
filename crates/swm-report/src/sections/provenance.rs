//! The section of provenance: commands, versions, hashes and configuration of every results file.

use crate::text::escape;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Manifest, Results};

/// Writes the section; `command` replaces the commands in the manifests.
pub(crate) fn write(html: &mut String, results: &[(PathBuf, Results)], command: Option<&str>) {
    html.push_str("<section>\n<h2>Provenance</h2>\n");
    if let Some(command) = command {
        let _ = write!(html, "<p>The command that reproduces these results:</p>\n<pre>{}</pre>\n", escape(command));
    }
    for (i, (path, result)) in results.iter().enumerate() {
        let number = if results.len() > 1 { format!("[{}] ", i + 1) } else { String::new() };
        let _ = writeln!(html, "<h3>{number}<code>{}</code></h3>", escape(&short_path(path)));
        let config = &result.manifest.config;
        let recorded = config.get("command").and_then(serde_json::Value::as_str).map(str::to_owned);
        // `swm reproduce` requires a request with a version.
        let reproduce = config.get("version").map(|_| format!("swm reproduce {}", short_path(path)));
        match (recorded.or(reproduce), command) {
            (Some(command), None) => {
                let _ = write!(
                    html,
                    "<p>The command that reproduces the results and lists all differences:</p>\n<pre>{}</pre>\n",
                    escape(&command)
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
        let _ = writeln!(html, "<div><dt>{}</dt><dd{class}>{}</dd></div>", escape(name), escape(value));
    };
    entry("kind", &manifest.kind, "");
    entry("stable-worldmodel", &manifest.swm_version, "");
    entry("seed", &manifest.seed.to_string(), "");
    entry("device", &manifest.device, "");
    for (library, version) in &manifest.libraries {
        entry(library, version, "");
    }
    for (what, hash) in &manifest.hashes {
        entry(&format!("{what} (BLAKE3)"), hash, " class=\"hash\"");
    }
    html.push_str("</dl>\n");
    if !manifest.config.is_null() {
        let config = serde_json::to_string_pretty(&manifest.config).unwrap_or_else(|_| manifest.config.to_string());
        let _ =
            write!(html, "<details>\n<summary>Configuration</summary>\n<pre>{}</pre>\n</details>\n", escape(&config));
    }
}
