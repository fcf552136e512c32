//! The zoo: capsules by name. `zoo:push-t/lewm` is the file `push-t/lewm.safetensors` of the first folder in
//! [`folders`] that has it.

use crate::{home, library};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;
use swm_core::{EnvEntry, Error, Result, files};
use swm_models::capsule::Capsule;

/// The start of a name in the zoo.
pub const PREFIX: &str = "zoo:";

/// The suffix of a capsule.
const SUFFIX: &str = "safetensors";

/// The zoo relative to the folder of an installation.
const SHARE: &str = "share/swm/zoo";

/// The folder of the data wheel, the Python package of all capsules (`python/zoo`).
static DATA_WHEEL: OnceLock<PathBuf> = OnceLock::new();

/// The file of a zoo that lists the capsules which only the data wheel has, a name a line.
const IN_DATA_WHEEL: &str = "data-wheel.txt";

/// The most bytes of that file.
const MAX_LIST: u64 = 1 << 20;

/// What a user does to get these capsules.
pub const INSTALL_ALL: &str = "pip install \"stable-worldmodel-rs[zoo]\"";

/// The deepest folder of a zoo that is listed: `ENVIRONMENT/MODEL.safetensors`.
const DEPTH: usize = 2;

/// Returns the folders that are searched, in order: `$SWM_ZOO`; `zoo/` in the home folder; `share/swm/zoo` in the Python
/// package, and the [data wheel](set_data_wheel); `share/swm/zoo` in the folder of the program, and in that folder's parent; `zoo/`
/// of the source tree that the program was built from. Folders that do not exist are left out.
pub fn folders() -> Vec<PathBuf> {
    let library = library::path();
    // A program that is found through `$PATH` has a name without a folder.
    let package = library.as_deref().and_then(Path::parent).filter(|folder| !folder.as_os_str().is_empty());
    let package = package.map(|folder| folder.join(SHARE)).into_iter().chain(DATA_WHEEL.get().cloned());
    let program = std::env::current_exe().ok();
    let beside =
        program.iter().flat_map(|program| program.ancestors().skip(1).take(2)).map(|folder| folder.join(SHARE));
    let given = std::env::var_os("SWM_ZOO").filter(|folder| !folder.is_empty()).map(PathBuf::from);
    let home = home::home().ok().map(|home| home.join("zoo"));
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).map(|root| root.join("zoo"));
    let all = given.into_iter().chain(home).chain(package).chain(beside).chain(source);
    all.filter(|folder| folder.is_dir()).collect()
}

/// Sets the folder of the data wheel. Only the Python interpreter knows where it has its packages, so the extension module sets it
/// when it is loaded. Later calls change nothing.
pub fn set_data_wheel(folder: PathBuf) {
    let _ = DATA_WHEEL.set(folder);
}

/// Returns the capsules of all folders by name. A capsule of an earlier folder hides one of the same name in a later
/// folder.
pub fn capsules() -> BTreeMap<String, PathBuf> {
    let mut found = BTreeMap::new();
    for folder in folders() {
        add(&folder, "", DEPTH, &mut found);
    }
    found
}

/// Adds the capsules of a folder, whose names begin with `prefix`.
fn add(folder: &Path, prefix: &str, depth: usize, found: &mut BTreeMap<String, PathBuf>) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for path in entries.map(|entry| entry.path()) {
        let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) else { continue };
        if path.is_dir() && depth > 1 {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            add(&path, &format!("{prefix}{name}/"), depth - 1, found);
        } else if path.is_file() && path.extension().is_some_and(|end| end == SUFFIX) {
            found.entry(format!("{prefix}{stem}")).or_insert(path);
        }
    }
}

/// Returns the names of the capsules that are not installed and that the data wheel has, as the zoo of a Python package without
/// them lists them.
pub fn in_data_wheel() -> BTreeSet<String> {
    let found = capsules();
    let lists = folders().into_iter().filter_map(|folder| files::read(&folder.join(IN_DATA_WHEEL), MAX_LIST).ok());
    let names = lists
        .flat_map(|list| String::from_utf8_lossy(&list).lines().map(|line| line.trim().to_owned()).collect::<Vec<_>>());
    names.filter(|name| !name.is_empty() && !found.contains_key(name)).collect()
}

/// Returns the path of the capsule with this name, without the prefix.
///
/// # Errors
/// When no folder of the zoo has it; the message names the closest name, or the data wheel.
pub fn find(name: &str) -> Result<PathBuf> {
    let is_plain = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let mut paths = folders().into_iter().map(|folder| folder.join(format!("{name}.{SUFFIX}")));
    if is_plain
        && !name.is_empty()
        && let Some(path) = paths.find(|path| path.is_file())
    {
        return Ok(path);
    }
    if in_data_wheel().contains(name) {
        let hint = format!("the Python package stable-worldmodel-rs-zoo has it, which is not installed: {INSTALL_ALL}");
        return Err(Error::UnknownName { kind: "capsule", given: name.to_owned(), nearest: vec![], hint });
    }
    let known = capsules();
    let hint = format!("`swm zoo` lists the capsules; it searches {}", listed(&folders()));
    Err(Error::unknown("capsule", name, known.keys().map(String::as_str), hint))
}

/// The last part of the name of a capsule that plays an environment without a scripted expert: `cartpole-swingup/expert`.
const EXPERT: &str = "/expert";

/// Returns the capsules named `expert`, such as `zoo:cartpole-swingup/expert`, with the environments that they were trained on. A
/// damaged capsule is left out; `swm zoo` shows its error.
pub fn experts() -> Vec<(String, String)> {
    let named = capsules().into_iter().filter(|(name, _)| name.ends_with(EXPERT));
    let of = |(name, path): (String, PathBuf)| {
        Some((format!("{PREFIX}{name}"), Capsule::read(&path).ok()?.env()?.to_owned()))
    };
    named.filter_map(of).collect()
}

/// Returns the capsule that the policy `name` means: for `expert`, where the environment `id`, with its options such as
/// `swm/CartpoleDMControl-v0,task=swingup`, has no scripted expert and the zoo has one.
pub fn trained_expert(entry: &EnvEntry, id: &str, name: &str) -> Option<String> {
    let is_asked = name == "expert" && entry.experts.is_empty();
    is_asked.then(experts)?.into_iter().find(|(_, env)| env == id).map(|(name, _)| name)
}

fn listed(folders: &[PathBuf]) -> String {
    let folders: Vec<String> = folders.iter().map(|folder| folder.display().to_string()).collect();
    if folders.is_empty() { "$SWM_ZOO and the home folder's zoo/".to_owned() } else { folders.join(", ") }
}
