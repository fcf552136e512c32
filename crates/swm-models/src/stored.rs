//! [`StoredCheckpoint`]: the parts of a checkpoint of any family, read from the folder of a run or from a capsule.

use crate::capsule::Capsule;
use crate::nn::Init;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::run_folder::{
    CHECKPOINT_FILES, CONFIG, FOLDER, MANIFEST, NEW_FOLDER, OLD_FOLDER, OPTIMIZER, PLAYED, RAW, WEIGHTS, WORLD_MODEL,
};
use crate::train::limits;
use crate::{tensor_file, weights};
use burn::module::Module;
use burn::tensor::Device;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Manifest, Result, manifest};

/// The parts of a checkpoint of any family.
#[derive(Clone, Debug)]
pub struct StoredCheckpoint {
    /// The run folder, or the capsule.
    run: PathBuf,
    /// The file that holds the configuration: `config.json` of a folder, or the capsule.
    path: PathBuf,
    /// Family, configuration and statistics of the dataset: the content of `config.json`.
    file: Value,
    manifest: Manifest,
    /// The hash of `config.json`; `None` for a capsule, which has a hash of its whole content.
    config_hash: Option<String>,
    weights: Weights,
    /// The world model in the run folder, of a checkpoint in memory.
    world_model: Option<Box<StoredCheckpoint>>,
}

/// The weights of a stored checkpoint.
#[derive(Clone, Debug)]
enum Weights {
    /// A file in the folder of the checkpoint.
    File(PathBuf),
    /// The weights of a capsule.
    Loaded(Named<HostTensor>),
}

impl StoredCheckpoint {
    /// Reads the checkpoint of a run folder (or the checkpoint folder itself), or a capsule. The weights of a folder are
    /// read when they are needed.
    ///
    /// # Errors
    /// When there is no checkpoint at `run`, or it is damaged.
    pub fn read(run: &Path) -> Result<Self> {
        if run.is_file() {
            return Ok(Self::of(run, &Capsule::read(run)?));
        }
        let folder = locate(run).ok_or_else(|| missing(run))?;
        let path = folder.join(CONFIG);
        let text = read_text(&path)?;
        let file = serde_json::from_slice(&text).map_err(|error| broken(&path, error.to_string()))?;
        let manifest = read_manifest(&folder)?;
        let weights = Weights::File(folder.join(WEIGHTS));
        let config_hash = Some(manifest::hash(&text));
        Ok(Self { run: run.to_owned(), path, file, manifest, config_hash, weights, world_model: None })
    }

    /// Returns the checkpoint in a capsule; `path` names the capsule in errors.
    pub fn of(path: &Path, capsule: &Capsule) -> Self {
        Self {
            run: path.to_owned(),
            path: path.to_owned(),
            file: capsule.checkpoint.clone(),
            manifest: capsule.manifest.clone(),
            config_hash: None,
            weights: Weights::Loaded(capsule.weights.clone()),
            world_model: None,
        }
    }

    /// Returns a checkpoint of these parts; `run` names it in errors. `file` is the content of `config.json`.
    pub(crate) fn of_parts(run: &Path, file: Value, manifest: Manifest, weights: Named<HostTensor>) -> Self {
        let weights = Weights::Loaded(weights);
        let path = run.join(CONFIG);
        Self { run: run.to_owned(), path, file, manifest, config_hash: None, weights, world_model: None }
    }

    /// Returns this checkpoint with another manifest and other weights.
    pub(crate) fn with(&self, manifest: Manifest, weights: Named<HostTensor>) -> Self {
        Self { manifest, weights: Weights::Loaded(weights), ..self.clone() }
    }

    /// Returns this checkpoint with its weights in memory: a training that replaces the files does not change it.
    ///
    /// # Errors
    /// As [`StoredCheckpoint::weights`].
    pub fn in_memory(self) -> Result<Self> {
        let weights = Weights::Loaded(self.weights()?);
        let has_world_model = self.world_model.is_none() && self.has_world_model();
        let world_model = if has_world_model { Some(Box::new(self.world_model()?.in_memory()?)) } else { None };
        Ok(Self { weights, world_model, ..self })
    }

    /// Returns the world model in the run folder.
    ///
    /// # Errors
    /// As [`StoredCheckpoint::read`].
    pub(crate) fn world_model(&self) -> Result<Self> {
        match &self.world_model {
            Some(stored) => Ok((**stored).clone()),
            None => Self::read(&self.run.join(WORLD_MODEL)),
        }
    }

    /// Returns the run folder, or the path of the capsule.
    pub fn run(&self) -> &Path {
        &self.run
    }

    /// Returns the id of the model's family, or `unknown`.
    pub fn family(&self) -> &str {
        self.file.get("family").and_then(Value::as_str).unwrap_or("unknown")
    }

    /// Returns the provenance of the checkpoint.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Returns the content of `config.json`.
    pub(crate) fn content(&self) -> &Value {
        &self.file
    }

    /// Returns the folder of the checkpoint's files; `None` for a capsule.
    pub(crate) fn folder(&self) -> Option<&Path> {
        match &self.weights {
            Weights::File(path) => path.parent(),
            Weights::Loaded(_) => None,
        }
    }

    /// Returns whether the run folder of the checkpoint holds the checkpoint of a world model, too.
    pub(crate) fn has_world_model(&self) -> bool {
        locate(&self.run.join(WORLD_MODEL)).is_some()
    }

    /// Returns the content of `config.json` as a typed value.
    ///
    /// # Errors
    /// When a field is missing or has another type.
    pub(crate) fn parsed<T: DeserializeOwned>(&self) -> Result<T> {
        serde_json::from_value(self.file.clone()).map_err(|error| self.broken(error.to_string()))
    }

    /// Returns the configuration of a checkpoint of the family `family`.
    ///
    /// # Errors
    /// When the checkpoint is of another family, or the configuration is damaged.
    pub(crate) fn config<C: DeserializeOwned>(&self, family: &str) -> Result<C> {
        if self.family() != family {
            return Err(Error::corrupt(
                &self.path,
                format!("it holds a model of the family '{}'", self.family()),
                format!("give a checkpoint of the family '{family}'"),
            ));
        }
        let config = self.file.get("config").cloned().unwrap_or_default();
        serde_json::from_value(config).map_err(|error| self.broken(error.to_string()))
    }

    /// Returns the weights, after checking their hash if the manifest has one.
    ///
    /// # Errors
    /// When the file is damaged, is not the file of the hash, or holds values that are not finite.
    pub fn weights(&self) -> Result<Named<HostTensor>> {
        match &self.weights {
            Weights::File(path) => read_tensors(path, self.manifest.hashes.get("weights")),
            Weights::Loaded(weights) => Ok(weights.clone()),
        }
    }

    /// Creates a model, which may be little larger than the weights, and loads the weights into it.
    ///
    /// # Errors
    /// As [`StoredCheckpoint::weights`], and when the names or shapes of the weights differ from the model's.
    pub(crate) fn model<M: Module>(&self, create: impl FnOnce(&Init) -> Result<M>, device: &Device) -> Result<M> {
        let weights = self.weights()?;
        let path = match &self.weights {
            Weights::File(path) => path,
            Weights::Loaded(_) => &self.path,
        };
        let init = Init::for_weights(&weights, device);
        let model = create(&init)?;
        init.check().map_err(|_| broken(path, format!("{CONFIG} describes a larger model than these weights")))?;
        let model = with_weights(model, &weights, path)?;
        self.check_config()?;
        Ok(model)
    }

    /// Checks the hash of `config.json` if the manifest has one, and that the manifest of a training repeats its settings:
    /// statistics of the data and settings of the frames change what a model computes without changing its weights. A capsule
    /// is checked where it is read.
    pub(crate) fn check_config(&self) -> Result<()> {
        let Some(found) = &self.config_hash else { return Ok(()) };
        if self.manifest.hashes.get("config").is_some_and(|expected| expected != found) {
            return Err(self.broken(format!("is not the file that {MANIFEST} describes: the hash differs")));
        }
        let shown = &self.manifest.config;
        let contradiction = (self.manifest.kind == "train").then(|| contradiction("", shown, &self.file["config"]));
        match contradiction.flatten() {
            Some(key) => Err(self.broken(format!("states another value of '{key}' than the config in {MANIFEST}"))),
            None => Ok(()),
        }
    }

    /// Returns the error for damage in the configuration.
    pub(crate) fn broken(&self, problem: String) -> Error {
        broken(&self.path, problem)
    }
}

/// Returns the dotted key of a setting that two configurations state differently. Settings that one of them lacks may have been
/// added since it was written.
fn contradiction(at: &str, left: &Value, right: &Value) -> Option<String> {
    match (left, right) {
        (Value::Null, _) | (_, Value::Null) => None,
        (Value::Object(left), Value::Object(right)) => left.iter().find_map(|(key, value)| {
            let at = if at.is_empty() { key.clone() } else { format!("{at}.{key}") };
            contradiction(&at, value, right.get(key)?)
        }),
        _ => (left != right).then(|| at.to_owned()),
    }
}

/// Returns the family of the model at `run`; `None` if there is no checkpoint.
pub fn family(run: &Path) -> Option<String> {
    let file: Value = match run.is_file() {
        true => StoredCheckpoint::read(run).ok()?.file,
        false => serde_json::from_slice(&read_text(&locate(run)?.join(CONFIG)).ok()?).ok()?,
    };
    Some(file.get("family")?.as_str()?.to_owned())
}

/// Returns whether a run folder has no checkpoint but the beginning of one, which a killed program leaves. The
/// configuration is written first; before it is there, the folder has its temporary files at most.
pub fn is_unfinished(run: &Path) -> bool {
    let new = run.join(NEW_FOLDER);
    locate(run).is_none() && (is_begun(&new) || is_created(&new))
}

/// Returns whether a folder is empty, or holds only what a kill leaves of writing the configuration of a checkpoint.
fn is_created(folder: &Path) -> bool {
    let is_temporary = |name: &str| {
        let process = name.strip_prefix('.').and_then(|name| name.strip_prefix(CONFIG)?.strip_prefix('.'));
        process.and_then(|process| process.strip_suffix(".tmp")).is_some_and(|process| process.parse::<u32>().is_ok())
    };
    let is_own = |entry: std::io::Result<std::fs::DirEntry>| {
        entry.is_ok_and(|entry| {
            entry.file_type().is_ok_and(|kind| kind.is_file()) && entry.file_name().to_str().is_some_and(is_temporary)
        })
    };
    let is_folder = std::fs::symlink_metadata(folder).is_ok_and(|found| found.is_dir());
    is_folder && std::fs::read_dir(folder).is_ok_and(|mut entries| entries.all(is_own))
}

/// Returns whether a folder has the configuration of a checkpoint, which is written first.
pub(crate) fn is_begun(folder: &Path) -> bool {
    let config = || -> Option<Value> { serde_json::from_slice(&read_text(&folder.join(CONFIG)).ok()?).ok() };
    config().is_some_and(|config| config["family"].is_string())
}

/// Checks that a folder has no entry with a name of a checkpoint or of a training run, whatever its content, so that a
/// checkpoint written there replaces nothing.
///
/// # Errors
/// When there is such an entry, or the folder cannot be listed. A missing folder is not an error.
pub fn check_unused(run: &Path) -> Result<()> {
    let io = |error| Error::io(run, "listing the folder", error);
    let entries = match std::fs::read_dir(run) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(io)?,
    };
    let mut names = vec![];
    for entry in entries {
        names.push(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    let is_used = |name: &&String| {
        let fixed = [CONFIG, FOLDER, NEW_FOLDER, OLD_FOLDER, "train.jsonl", "best", WORLD_MODEL];
        fixed.contains(&name.as_str()) || name.starts_with(PLAYED) || is_event_file(name)
    };
    let Some(name) = names.iter().find(is_used) else { return Ok(()) };
    let problem = format!("holds a checkpoint already, or files with such names: '{name}' exists");
    let fix = "choose another folder, or `swm checkpoints remove` a checkpoint";
    Err(Error::config(run.display().to_string(), problem, fix))
}

/// Writes a checkpoint to a run folder that holds none, and keeps other writers away meanwhile. If `write` fails, a folder that it
/// leaves empty is removed.
///
/// # Errors
/// As [`check_unused`], when another process writes to `run`, and when `write` fails.
pub(crate) fn write_unused(run: &Path, write: impl FnOnce() -> Result<String>) -> Result<String> {
    let existed = run.is_dir();
    let _lock = Lock::folder(run)?;
    check_unused(run)?;
    let written = write();
    if written.is_err() && !existed {
        // The error of writing says more.
        let _ = files::remove_empty_folder(run);
    }
    written
}

/// Checks that a folder that a checkpoint replaces has files of a checkpoint only beside the configuration of one.
///
/// # Errors
/// When it has such files of another program.
pub(crate) fn check_replaceable(run: &Path) -> Result<()> {
    for folder in [FOLDER, NEW_FOLDER, OLD_FOLDER].map(|folder| run.join(folder)) {
        if is_occupied(&folder) && !is_begun(&folder) {
            let problem = "has files with the names of a checkpoint, and is none of this program";
            let fix = "move them away, or choose another folder";
            return Err(Error::config(folder.display().to_string(), problem, fix));
        }
    }
    Ok(())
}

/// Returns whether a path is a file or a link, or a folder with a file that a checkpoint would replace.
pub(crate) fn is_occupied(folder: &Path) -> bool {
    match std::fs::symlink_metadata(folder) {
        Err(_) => false,
        Ok(found) if !found.is_dir() => true,
        Ok(_) => CHECKPOINT_FILES.iter().any(|name| std::fs::symlink_metadata(folder.join(name)).is_ok()),
    }
}

/// Returns whether a file name is that of a TensorBoard event file of this program.
pub(crate) fn is_event_file(name: &str) -> bool {
    name.starts_with("events.out.tfevents.") && name.ends_with(".swm")
}

/// Returns the faults of a checkpoint that loading does not find: files without a hash in the manifest, and
/// a training state whose hash differs. A capsule has none, because loading it checks all hashes.
///
/// # Errors
/// When there is no checkpoint, or a file cannot be read.
pub fn faults(run: &Path) -> Result<Vec<String>> {
    if run.is_file() {
        return Ok(vec![]);
    }
    let present = || locate(run).map(|folder| (read_text(&folder.join(MANIFEST)).ok(), folder));
    let mut known = present();
    loop {
        let found = faults_of_folder(run);
        let now = present();
        // A training that saves meanwhile replaces the whole folder.
        if now == known || found.as_ref().is_ok_and(Vec::is_empty) {
            return found;
        }
        known = now;
    }
}

fn faults_of_folder(run: &Path) -> Result<Vec<String>> {
    let folder = locate(run).ok_or_else(|| missing(run))?;
    let manifest = read_manifest(&folder)?;
    let mut faults = vec![];
    for (name, file) in [("config", CONFIG), ("weights", WEIGHTS), ("optimizer", OPTIMIZER), ("raw", RAW)] {
        let path = folder.join(file);
        match manifest.hashes.get(name) {
            Some(hash) if *hash != manifest::hash(&files::read(&path, u64::MAX)?) => {
                faults.push(format!("{file} is not the file that {MANIFEST} describes: its hash differs"));
            }
            None if path.exists() => faults.push(format!("{MANIFEST} holds no hash of {file}")),
            _ => {}
        }
    }
    let world_model = run.join(WORLD_MODEL);
    if locate(&world_model).is_some() {
        faults.extend(faults_of_folder(&world_model)?.into_iter().map(|fault| format!("{WORLD_MODEL}: {fault}")));
    }
    Ok(faults)
}

/// Replaces the weights of a model by those of the file `path`.
pub(crate) fn with_weights<M: Module>(model: M, weights: &Named<HostTensor>, path: &Path) -> Result<M> {
    match weights::mismatch(&parameters::shapes(&model), weights, CONFIG) {
        Some(problem) => Err(broken(path, problem)),
        None => Ok(parameters::load(model, weights)),
    }
}

/// Returns the folder of a run's checkpoint: `run`, the folder `checkpoint` in `run`, or the old checkpoint, which
/// remains if a process was killed between the two renamings.
pub(crate) fn locate(run: &Path) -> Option<PathBuf> {
    [run.to_owned(), run.join(FOLDER), run.join(OLD_FOLDER)].into_iter().find(|folder| folder.join(CONFIG).is_file())
}

/// Reads a JSON file of a checkpoint.
pub(crate) fn read_text(path: &Path) -> Result<Vec<u8>> {
    files::read(path, limits::JSON_BYTES)
}

/// Reads the tensors of a file of a checkpoint, after checking the hash of the file if `hash` is given.
pub(crate) fn read_tensors(path: &Path, hash: Option<&String>) -> Result<Named<HostTensor>> {
    let bytes = files::read(path, u64::MAX)?;
    let tensors = tensor_file::decode(&bytes).map_err(|problem| broken(path, problem))?;
    if hash.is_some_and(|hash| *hash != manifest::hash(&bytes)) {
        return Err(broken(path, format!("is not the file that {MANIFEST} describes: the hash differs")));
    }
    Ok(tensors)
}

/// Returns the error for a damaged file of a checkpoint.
pub(crate) fn broken(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "train again, or copy the checkpoint again from its source")
}

/// Returns the error for a path without a checkpoint.
pub(crate) fn missing(run: &Path) -> Error {
    Error::corrupt(run, "there is no checkpoint", "give the folder that `swm train` wrote to, or a capsule")
}

fn read_manifest(folder: &Path) -> Result<Manifest> {
    let path = folder.join(MANIFEST);
    serde_json::from_slice(&read_text(&path)?).map_err(|error| broken(&path, error.to_string()))
}
