//! The registries of the program, read through its own commands, and the pages of their rows.

use super::pages::{self, Group, Page, file_name, string};
use crate::source;
use anyhow::{Context as _, Result, bail};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// Returns the generated pages. Frames of environments are written below `source`.
pub fn groups(program: &Path, source: &Path) -> Result<Vec<Group>> {
    Ok(vec![
        environments(program, source)?,
        wrappers(program)?,
        solvers(program)?,
        models(program)?,
        formats(program)?,
        commands(program)?,
    ])
}

fn environments(program: &Path, source: &Path) -> Result<Group> {
    let readmes = readmes()?;
    let scratch = source.join("scratch");
    let all = json(program, &["envs"])?;
    let rows = pages::entries(&all).into_iter().map(|(id, env)| {
        let images = if env["missing"].is_null() { frames(program, id, source, &scratch)? } else { vec![] };
        let notes = readmes.iter().find(|(_, text)| text.contains(&format!("`{id}`")));
        let notes = notes.map(|(path, _)| format!("../{}", super::page_name(path)));
        let text = pages::environment(id, env, &images, notes.as_deref());
        Ok((string(&env["summary"]), page("environments", id, text)))
    });
    let rows = rows.collect::<Result<Vec<_>>>()?;
    if scratch.exists() {
        std::fs::remove_dir_all(&scratch)?;
    }
    let introduction = "Native environments. [Gymnasium environments](../gymnasium.md) work with every command, too.";
    Ok(Group::new("environments", "Environments", introduction, rows))
}

/// The pages about environments that lie beside their code.
fn readmes() -> Result<BTreeMap<String, String>> {
    let files = source::files(&crate::root(), &["README.md"])?;
    let of_envs = |path: &str| path.starts_with("crates/swm-envs/") || path.starts_with("crates/swm-mujoco/");
    Ok(files.into_iter().filter(|file| of_envs(&file.path)).map(|file| (file.path, file.text)).collect())
}

/// The number of initial states of an environment that its page shows.
const STATES: usize = 4;

/// Writes frames of some initial states of an environment, all factors sampled. Returns their paths from the page.
fn frames(program: &Path, id: &str, source: &Path, scratch: &Path) -> Result<Vec<String>> {
    let (data, states) = (scratch.to_string_lossy(), STATES.to_string());
    let collect =
        ["collect", id, "--output", &data, "--format", "folder", "--codec", "png", "--overwrite", "--policy", "random"];
    let settings = ["--episodes", &states, "--max-steps", "1", "--envs", "1", "--image", "192", "--variation", "all"];
    run(program, &[&collect[..], &settings].concat())?;
    let folder = source.join("environments/images");
    std::fs::create_dir_all(&folder)?;
    let copied = (0..STATES).map(|state| {
        let name = format!("{}-{state}.png", file_name(id));
        // The format has this ending for images of every codec.
        let from = scratch.join(format!("pixels/ep_{state}_step_0.jpeg"));
        std::fs::copy(&from, folder.join(&name)).with_context(|| format!("copying {}", from.display()))?;
        Ok(format!("images/{name}"))
    });
    copied.collect()
}

fn wrappers(program: &Path) -> Result<Group> {
    let rows = rows(program, "wrappers", pages::wrapper)?;
    Ok(Group::new(
        "wrappers",
        "Wrappers",
        "Changes of rendered frames, which stack. See [Visual wrappers](../wrappers.md).",
        rows,
    ))
}

fn solvers(program: &Path) -> Result<Group> {
    let introduction = "Searches for actions that a model predicts to reach the goal, for `swm eval --solver` and \
                        `swm.planning` in Python.";
    Ok(Group::new("solvers", "Solvers", introduction, rows(program, "solvers", pages::solver)?))
}

fn models(program: &Path) -> Result<Group> {
    let mut rows = vec![];
    for (id, family) in pages::entries(&json(program, &["models"])?) {
        let mut presets = vec![];
        for preset in family["presets"].as_array().into_iter().flatten() {
            let name = string(&preset["id"]);
            let settings = run(program, &["train", id, "--preset", &name, "--print-config"])?;
            presets.push((name, string(&preset["summary"]), settings));
        }
        let summary = string(&family["summary"]);
        let text = pages::model(id, &summary, &presets);
        rows.push((summary, page("families", id, text)));
    }
    Ok(Group::new(
        "families",
        "Presets of the models",
        "Complete settings of every preset. See [Training](../training.md).",
        rows,
    ))
}

fn formats(program: &Path) -> Result<Group> {
    let all = json(program, &["formats"])?;
    let rows = all.as_array().into_iter().flatten().map(|format| {
        let id = string(&format["id"]);
        let text = pages::format(&id, format);
        (string(&format["summary"]), page("formats", &id, text))
    });
    Ok(Group::new("formats", "Formats", "Dataset formats. See [Datasets](../data.md).", rows.collect()))
}

/// The commands, with the help that the program prints.
fn commands(program: &Path) -> Result<Group> {
    let folder = std::env::temp_dir().join(format!("swm-book-{}", std::process::id()));
    let listed = run(program, &["man", "--output", &folder.to_string_lossy()])?;
    std::fs::remove_dir_all(&folder)?;
    let names =
        listed.lines().filter_map(|line| Path::new(line).file_stem()?.to_str().map(|stem| stem.replace('-', " ")));
    let mut helps: BTreeMap<String, Vec<(String, String)>> = BTreeMap::new();
    for command in names.filter(|name| name != "swm") {
        let words: Vec<&str> = command.split(' ').skip(1).chain(["--help"]).collect();
        let help = run(program, &words)?;
        helps.entry(words[0].to_owned()).or_default().push((command, help));
    }
    let rows = helps.into_iter().map(|(name, mut helps)| {
        helps.sort();
        let summary = helps[0].1.lines().next().unwrap_or_default().to_owned();
        let text = pages::command(&name, &helps);
        (summary, Page { title: format!("swm {name}"), path: format!("commands/{name}.md"), text })
    });
    let introduction = "Every command has `--help`. `swm man --output DIR` writes these pages for `man`, and `swm completions bash` \
                        (or `zsh`, `fish`) completes commands, options and values in your shell.";
    Ok(Group::new("commands", "Commands", introduction, rows.collect()))
}

/// The pages of a registry whose command prints an object with a field for each row.
fn rows(program: &Path, name: &str, text: fn(&str, &Value) -> String) -> Result<Vec<(String, Page)>> {
    let all = json(program, &[name])?;
    let rows =
        pages::entries(&all).into_iter().map(|(id, row)| (string(&row["summary"]), page(name, id, text(id, row))));
    Ok(rows.collect())
}

fn page(group: &str, id: &str, text: String) -> Page {
    Page { title: id.to_owned(), path: format!("{group}/{}.md", file_name(id)), text }
}

fn json(program: &Path, args: &[&str]) -> Result<Value> {
    let args: Vec<&str> = args.iter().copied().chain(["--json"]).collect();
    serde_json::from_str(&run(program, &args)?).with_context(|| format!("reading the output of swm {}", args.join(" ")))
}

/// Runs the program and returns its standard output.
fn run(program: &Path, args: &[&str]) -> Result<String> {
    let output = Command::new(program).args(args).output();
    let output = output.with_context(|| format!("starting {}", program.display()))?;
    if !output.status.success() {
        bail!("swm {}: {}", args.join(" "), String::from_utf8_lossy(&output.stderr));
    }
    Ok(String::from_utf8(output.stdout)?)
}
