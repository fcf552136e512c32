//! Studies whose cells are no evaluations: files with a `kind`.
//!
//! - `factors`: the number of factors of variation of every environment; no environment is stepped.
//! - `online`: returns of models that train by interaction.
//! - `drift`: how far the latents of policies lie from those that a model was trained on.
//! - `data`: the speed, latency and size of every format of datasets, on the local disk and in an object store.

use super::any_file::Size;
use super::chosen::{Chosen, check_cells, known, settings_of};
use super::drift::{self, DriftSettings, Trained};
use super::online::{self, OnlineSettings};
use super::table_kind::TableKind;
use crate::cli::Context;
use crate::cli::progress::control;
use crate::cli::recipes::Datasets;
use crate::{ENVS, capsule};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use swm_bench::{DataBenchConfig, FormatBench};
use swm_core::results::TableColumn;
use swm_core::run::{Control, Event};
use swm_core::{Error, Origin, Result};
use swm_data::{ClipSpec, Location};
use swm_envs::wrappers::WRAPPERS;
use swm_eval::{Measured, StudyFolder, TableCell, TableStudy};
use toml::Table;

/// The file of such a study.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TableFile {
    kind: TableKind,
    /// The title.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// Where the published values come from.
    #[serde(default)]
    source: String,
    /// The datasets that the study collects.
    #[serde(default)]
    collect: Option<toml::Value>,
    #[serde(default)]
    defaults: Table,
    /// What replaces the defaults at the small size.
    #[serde(default)]
    small: Table,
    /// The published values of rows.
    #[serde(default)]
    published: BTreeMap<String, Vec<f64>>,
}

/// The name of the tables of datasets.
const COLLECT: &str = "collect";

/// The settings of the kind `data`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
struct DataSettings {
    /// The environments whose frames are loaded.
    envs: Vec<String>,
    /// Formats with codecs, as `swm bench data` names them.
    layouts: Vec<String>,
    /// Layouts that are also loaded from an object store.
    remote_layouts: Vec<String>,
    /// A folder of the object store; empty to leave these rows empty.
    remote: String,
    episodes: usize,
    steps: usize,
    /// The side length of frames, in pixels.
    size: usize,
    frames: usize,
    frameskip: usize,
    batch: usize,
    /// The number of measurements, and the seconds of each.
    repeats: usize,
    seconds: f64,
}

impl Default for DataSettings {
    fn default() -> Self {
        let config = DataBenchConfig::default();
        Self {
            envs: vec![],
            layouts: FormatBench::layouts().map(str::to_owned).collect(),
            remote_layouts: vec![],
            remote: String::new(),
            episodes: config.episodes,
            steps: config.steps,
            size: config.size,
            frames: config.clip.num_steps,
            frameskip: config.clip.frameskip,
            batch: config.batch_size,
            repeats: config.pairs,
            seconds: config.seconds,
        }
    }
}

impl TableFile {
    /// Parses a file; `path` is named in errors.
    ///
    /// # Errors
    /// When the text is not TOML, or has an unknown table, kind or key.
    pub fn parse(text: &str, path: &Path) -> Result<Self> {
        toml::from_str(text).map_err(|error| {
            let at = error.span().map_or(0, |span| span.start);
            let line = 1 + text.as_bytes().iter().take(at).filter(|byte| **byte == b'\n').count();
            let what = format!("{}:{line}", path.display());
            Error::config(what, error.message(), "docs/studies.md describes studies with a kind")
        })
    }

    /// Returns the study at a size, with settings `KEY=VALUE`.
    ///
    /// # Errors
    /// When there is no such setting, a value is invalid, or the file names what only the user may name.
    pub fn study(&self, size: Size, settings: &[String], origin: &Origin) -> Result<TableStudy> {
        let mut merged = self.defaults.clone();
        if size == Size::Small {
            merged.extend(self.small.clone());
            merged.remove(COLLECT);
        }
        let mut own = BTreeSet::new();
        for setting in settings {
            let Some((key, value)) = setting.split_once('=') else {
                return Err(Error::config(setting, "is not a setting", "write KEY=VALUE, such as episodes=20"));
            };
            if !own.insert(key) {
                return Err(Error::config(setting, "is given twice", "give it once"));
            }
            let parsed = toml::from_str::<Table>(&format!("value = {value}")).ok();
            let value = parsed.and_then(|mut table| table.remove("value"));
            merged.insert(
                key.to_owned(),
                value.unwrap_or_else(|| toml::Value::String(setting[key.len() + 1..].to_owned())),
            );
        }
        let chosen = Chosen::new(origin, own);
        let (subject, columns, cells) = match self.kind {
            TableKind::Factors => {
                known(&merged, &[])?;
                ("environment", factor_columns(), self.factors()?)
            }
            TableKind::Data => {
                let settings: DataSettings = settings_of(merged)?;
                settings.check(&chosen)?;
                ("dataset", data_columns(), self.data(&settings, size))
            }
            TableKind::Online => {
                let settings: OnlineSettings = settings_of(merged)?;
                settings.check(&chosen)?;
                ("run", online::columns(), settings.cells(|run| self.published_of(run, 1))?)
            }
            TableKind::Drift => {
                let settings: DriftSettings = settings_of(merged)?;
                settings.check(&chosen)?;
                ("policy", drift::columns(), settings.cells(&self.datasets(size)?.commands())?)
            }
        };
        let study = TableStudy {
            kind: self.kind.name().to_owned(),
            title: size.title(&self.title),
            question: self.question.clone(),
            subject: subject.to_owned(),
            columns,
            source: if size == Size::Small && self.kind == TableKind::Data {
                String::new()
            } else {
                self.source.clone()
            },
            cells,
            arguments: vec![],
        };
        study.check()?;
        Ok(study)
    }

    /// What a cluster needs to know of the study: its rows with their ids, whether they are one cell (`together`), and the name of
    /// the model that they share (`model`).
    ///
    /// # Errors
    /// Never for a study that was read from JSON.
    pub fn cluster_cells(&self, study: &TableStudy) -> Result<Value> {
        let ids = study.cells.iter().map(TableCell::id).collect::<Result<Vec<_>>>()?;
        let mut cells = json!({"study": study, "ids": ids});
        if self.kind.is_one_cell() {
            cells["together"] = json!(true);
        }
        if let (TableKind::Drift, Some(first)) = (self.kind, study.cells.first()) {
            cells["model"] = json!(drift::model_name(&first.request)?);
        }
        Ok(cells)
    }

    /// The datasets that the study collects at a size.
    ///
    /// # Errors
    /// When a table is invalid.
    pub fn datasets(&self, size: Size) -> Result<Datasets> {
        let tables = if size == Size::Small { self.small.get(COLLECT) } else { self.collect.as_ref() };
        tables.map_or(Ok(Datasets::default()), |tables| Datasets::parse(&self.title, tables.clone()))
    }

    /// A row for every environment of the registry, then for third-party environments with published numbers.
    fn factors(&self) -> Result<Vec<TableCell>> {
        let version = env!("CARGO_PKG_VERSION");
        let ids: Vec<&str> = ENVS.rows.iter().map(|row| row.id).collect();
        if let Some(id) = self.published.keys().find(|id| id.starts_with("swm/") && !ids.contains(&id.as_str())) {
            return Err(Error::unknown("environment", id, ids, "`swm envs` lists them"));
        }
        let third_party = self.published.keys().map(String::as_str).filter(|id| !ids.contains(id)).collect::<Vec<_>>();
        let cell = |key: &str, id: &str| TableCell {
            name: id.to_owned(),
            request: json!({"kind": TableKind::Factors.name(), key: id, "version": version}),
            published: self.published_of(id, 2),
        };
        let native = ids.into_iter().map(|id| cell("env", id));
        Ok(native.chain(third_party.into_iter().map(|name| cell("third-party", name))).collect())
    }

    /// A row for each environment, layout and storage.
    fn data(&self, settings: &DataSettings, size: Size) -> Vec<TableCell> {
        let mut cells = vec![];
        for env in &settings.envs {
            for layout in &settings.layouts {
                let is_remote = settings.remote_layouts.contains(layout);
                for (storage, remote) in [("local", None), ("object store", Some(&settings.remote))] {
                    if remote.is_some() && !is_remote {
                        continue;
                    }
                    let name = format!("{env}, {layout}, {storage}");
                    let mut request = json!(settings);
                    for list in ["envs", "layouts", "remote-layouts", "remote"] {
                        request.as_object_mut().map(|request| request.remove(list));
                    }
                    request["kind"] = json!(TableKind::Data.name());
                    request["env"] = json!(env);
                    request["layout"] = json!(layout);
                    request["remote"] = json!(remote);
                    let published = if size == Size::Small { vec![None; 2] } else { self.published_of(&name, 2) };
                    cells.push(TableCell { name, request, published });
                }
            }
        }
        cells
    }

    fn published_of(&self, name: &str, columns: usize) -> Vec<Option<f64>> {
        let values = self.published.get(name);
        (0..columns).map(|i| values.and_then(|values| values.get(i)).copied()).collect()
    }
}

fn column(name: &str, unit: &str) -> TableColumn {
    TableColumn { name: name.to_owned(), unit: unit.to_owned(), published: false }
}

fn published(name: &str, unit: &str) -> TableColumn {
    TableColumn { published: true, ..column(&format!("{name}, published"), unit) }
}

fn factor_columns() -> Vec<TableColumn> {
    let [native, all] = ["native", "with wrappers"];
    let of = |make: fn(&str, &str) -> TableColumn| [native, all].map(|name| make(name, "factors"));
    [of(column), of(published)].concat()
}

fn data_columns() -> Vec<TableColumn> {
    let [plain, cached] = ["clips/s", "clips/s, cached"];
    let of = |make: fn(&str, &str) -> TableColumn| [plain, cached].map(|name| make(name, "clips/s"));
    [of(column).to_vec(), vec![column("latency", "ms"), column("size", "MB")], of(published).to_vec()].concat()
}

impl DataSettings {
    fn check(&self, chosen: &Chosen<'_>) -> Result<()> {
        check_cells(&[self.envs.len(), self.layouts.len().max(self.remote_layouts.len())])?;
        if !((1..=1000).contains(&self.repeats) && self.seconds > 0.0 && self.seconds <= 3600.0) {
            let problem = format!("{} measurements of {} seconds", self.repeats, self.seconds);
            return Err(Error::config("settings of the study", problem, "give 1 to 1000 of at most 3600 seconds"));
        }
        for env in &self.envs {
            crate::env(env, chosen.by("envs"))?;
        }
        if !self.remote.is_empty() {
            let name = format!("the object store '{}'", self.remote);
            chosen.by("remote").check_user(&name, "which opens a network connection", Some("remote=URI"))?;
            Location::parse(&self.remote)?;
        }
        let layouts: Vec<&str> = FormatBench::layouts().collect();
        let unknown = self.layouts.iter().chain(&self.remote_layouts).find(|name| !layouts.contains(&name.as_str()));
        let hint = format!("the layouts are '{}'", layouts.join("', '"));
        unknown.map_or(Ok(()), |layout| Err(Error::unknown("layout", layout, layouts.iter().copied(), hint)))
    }
}

/// Fills the rows of a study that have no values yet.
///
/// # Errors
/// When the folder holds something else, a measurement fails, or the user stops the program.
pub fn run(study: &TableStudy, folder: &StudyFolder, context: &Context) -> Result<()> {
    let _lock = folder.create_table(study)?;
    if study.kind == TableKind::Factors.name() {
        study.run(folder, "", &mut |cell, control| Ok(count_factors(&cell.request, control)), &mut control(context))?;
        return Ok(());
    }
    if study.kind == TableKind::Drift.name() {
        let mut trained = None;
        let mut measure = |cell: &TableCell, control: &mut Control<'_>| {
            if trained.is_none() {
                trained = Some(Trained::new(cell, folder, context, control)?);
            }
            let row = cell.request["row"].as_str().unwrap_or_default();
            trained.as_ref().map(|trained| trained.measure(row, context, control)).transpose()
        };
        study.run(folder, "", &mut measure, &mut control(context))?;
        return Ok(());
    }
    if study.kind == TableKind::Online.name() {
        let mut measure = |cell: &TableCell, control: &mut Control<'_>| online::measure(cell, context, control);
        study.run(folder, "", &mut measure, &mut control(context))?;
        return Ok(());
    }
    let threads = if context.threads > 0 { context.threads } else { DataBenchConfig::default().threads };
    let machine = format!("{}, {threads} threads", capsule::cpu_level());
    let mut bench = None;
    let mut measure =
        |cell: &TableCell, control: &mut Control<'_>| measure(&cell.request, threads, &mut bench, control);
    study.run(folder, &machine, &mut measure, &mut control(context))?;
    Ok(())
}

/// The numbers of native factors, and of these and all wrappers; `None` for an environment whose libraries are missing.
fn count_factors(request: &Value, control: &mut Control<'_>) -> Option<Measured> {
    let native = match request["env"].as_str().map(|id| (id, ENVS.get(id).and_then(|entry| entry.env()))) {
        // Third-party environments declare no factors.
        None => 0,
        Some((_, Ok(env))) => env.spec().variation_space.factors().len(),
        Some((id, Err(error))) => {
            control.emit(Event::Log(&format!("{id} is left out: {error}")));
            return None;
        }
    };
    Some(vec![native as f64, (native + WRAPPERS.rows.len()) as f64].into())
}

/// Measures a row. `bench` holds the dataset of the last environment.
fn measure(
    request: &Value,
    threads: usize,
    bench: &mut Option<(String, FormatBench)>,
    control: &mut Control<'_>,
) -> Result<Option<Measured>> {
    let text = |key: &str| request[key].as_str().unwrap_or_default();
    let remote = request["remote"].as_str();
    if remote == Some("") {
        let what = format!("{} in an object store is not measured: name a folder, remote=URI", text("layout"));
        control.emit(Event::Log(&what));
        return Ok(None);
    }
    let remote = remote.map(Location::parse).transpose()?;
    let kept = bench.take().filter(|(env, _)| env == text("env"));
    let (env, made) = match kept {
        Some(kept) => kept,
        None => {
            let number = |key: &str| request[key].as_u64().unwrap_or_default() as usize;
            let clip = ClipSpec {
                num_steps: number("frames"),
                frameskip: number("frameskip"),
                ..DataBenchConfig::default().clip
            };
            let config = DataBenchConfig {
                episodes: number("episodes"),
                steps: number("steps"),
                size: number("size"),
                clip,
                batch_size: number("batch"),
                threads,
                pairs: number("repeats"),
                seconds: request["seconds"].as_f64().unwrap_or_default(),
                ..DataBenchConfig::default()
            };
            // The study has checked who chose the id.
            let env = crate::env(text("env"), &Origin::User)?;
            (text("env").to_owned(), FormatBench::new(&env, config, control)?)
        }
    };
    let cost = made.measure(text("layout"), remote.as_ref(), control)?;
    *bench = Some((env, made));
    Ok(Some(vec![cost.clips_per_second, cost.cached_clips_per_second, cost.latency_ms, cost.megabytes].into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn study(text: &str, settings: &[&str], origin: &Origin) -> Result<TableStudy> {
        let file = TableFile::parse(text, Path::new("study.toml"))?;
        let settings: Vec<String> = settings.iter().map(ToString::to_string).collect();
        file.study(Size::Paper, &settings, origin)
    }

    const DATA: &str = "kind = \"data\"\ntitle = \"T\"\nquestion = \"q?\"\n[defaults]\nenvs = [\"swm/PushT-v1\"]\n\
                        layouts = [\"hdf5\", \"video\"]\nremote-layouts = [\"hdf5\"]\n[small]\nsize = 32\n\
                        [published]\n\"swm/PushT-v1, hdf5, local\" = [1416, 1474]\n";

    #[test]
    fn rows_of_formats_have_settings_and_published_values() {
        let found = study(DATA, &["size=16"], &Origin::User).expect("a study");
        let names: Vec<&str> = found.cells.iter().map(|cell| cell.name.as_str()).collect();
        let of = |end: &str| format!("swm/PushT-v1, {end}");
        assert_eq!(names, [of("hdf5, local"), of("hdf5, object store"), of("video, local")]);
        assert_eq!(found.cells[0].published, [Some(1416.0), Some(1474.0)]);
        assert_eq!((&found.cells[0].request["size"], &found.cells[1].request["remote"]), (&json!(16), &json!("")));
        assert_eq!(found.columns.len(), 6);
        let small = TableFile::parse(DATA, Path::new("study.toml")).expect("a file");
        let small = small.study(Size::Small, &[], &Origin::User).expect("a study");
        assert_eq!((&small.cells[0].request["size"], &small.cells[0].published[..]), (&json!(32), &[None, None][..]));
        assert_ne!(small.title, found.title);
    }

    #[test]
    fn errors_name_the_line_or_the_nearest_name() {
        let stranger = Origin::file("study.toml", false);
        for (text, settings, parts) in [
            (DATA.replace("layouts = [\"hdf5\"", "layouts = [\"hdf6\""), vec![], ["hdf6", "hdf5"]),
            (DATA.replace("[small]", "[smaller]"), vec![], ["study.toml:8", "smaller"]),
            (DATA.replace("\"data\"", "\"date\""), vec![], ["study.toml:1", "date"]),
            (DATA.to_owned(), vec!["sizes=3"], ["sizes", "did you mean size"]),
            (DATA.to_owned(), vec!["seconds=0"], ["0 seconds", "3600"]),
            (DATA.replace("[small]", "remote = \"s3://bucket/a\"\n[small]"), vec![], ["s3://bucket/a", "remote=URI"]),
            (DATA.replace("swm/PushT-v1", "evil:X-v0"), vec![], ["evil:X-v0", "--trust"]),
        ] {
            let error = study(&text, &settings, &stranger).expect_err(parts[0]).to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        assert!(study(DATA, &["remote=s3://bucket/a"], &stranger).is_ok(), "the user's own");
    }

    #[test]
    fn presets_of_a_file_are_those_of_the_program() {
        let stranger = Origin::file("study.toml", false);
        let kind = |kind: &str, env: &str| {
            format!("kind = \"{kind}\"\ntitle = \"T\"\nquestion = \"q?\"\n[defaults]\n{env}\npreset = \"/dev/zero\"\n")
        };
        let drift = kind("drift", "env = \"swm/PushT-v1\"\ndataset = \"states\"");
        for text in [&drift, &kind("online", "envs = [\"swm/PendulumControl-v1\"]")] {
            // Who names the environment does not name the file.
            for settings in [&[] as &[&str], &["env=swm/PushT-v1"][..usize::from(*text == drift)]] {
                let error = study(text, settings, &stranger).expect_err("a file").to_string();
                assert!(error.contains("the preset '/dev/zero'") && error.contains("--trust"), "{error}");
            }
        }
        study(&drift, &["preset=tiny"], &stranger).expect("a preset of the program");
    }

    #[test]
    fn lists_with_countless_combinations_are_refused_before_cells_are_made() {
        let many = |item: &str| vec![item; 100_000].join(",");
        let envs = DATA.replace("\"swm/PushT-v1\"]", &format!("{}]", many("\"swm/PushT-v1\"")));
        let data = envs.replace("\"hdf5\", \"video\"", &many("\"hdf5\""));
        let [seeds, models, places] = [many("0"), many("\"sac\""), many("\"swm/PendulumControl-v1\"")];
        let online = format!(
            "kind = \"online\"\ntitle = \"T\"\nquestion = \"q?\"\n[defaults]\nenvs = [{places}]\nfamilies = [{models}]\n\
             seeds = [{seeds}]\n"
        );
        for (text, count) in [(data, "10000000000"), (online, "1000000000000000")] {
            let error = study(&text, &[], &Origin::User).expect_err("too many").to_string();
            assert!(error.contains(count) && error.contains("10000"), "{error}");
        }
    }
}
