//! Expands the tables of a study's file to cells.

use super::file::{OF_THE_COMMAND, StudyFile, Table, Variant};
use super::variants::Budget;
use crate::cli::eval::{CapsuleStarts, EvalArgs};
use crate::cli::usage;
use crate::resolver::HomeResolver;
use clap::{Args as _, Command, FromArgMatches as _};
use std::collections::{BTreeMap, BTreeSet};
use swm_core::run::Control;
use swm_core::{Error, Result};
use swm_data::{Part, Split};
use swm_eval::{Cell, EvalRequest, HeldOut, PROBE_DATASET, PolicyKind, Resolver as _, StartsRequest, Study};

/// A cell before its names are resolved.
struct Combination {
    starts: Variant,
    condition: Variant,
    policy: Variant,
    /// The options of all tables.
    all: Variant,
}

/// Returns the arguments of `swm eval` for every cell.
///
/// # Errors
/// When a table is invalid.
pub fn commands(file: &StudyFile, settings: &[String], resolver: &HomeResolver) -> Result<Vec<Vec<String>>> {
    Ok(combinations(file, settings, resolver)?.iter().map(|combination| combination.all.arguments()).collect())
}

/// Joins arguments for a shell.
pub fn shell(arguments: &[String]) -> String {
    let plain = |argument: &String| {
        let safe = |c: char| c.is_ascii_alphanumeric() || "-_=.,/:@%+".contains(c);
        if !argument.is_empty() && argument.chars().all(safe) {
            argument.clone()
        } else {
            format!("'{}'", argument.replace('\'', "'\\''"))
        }
    };
    arguments.iter().map(plain).collect::<Vec<_>>().join(" ")
}

/// Returns the study with all names resolved.
///
/// # Errors
/// When a table is invalid, an environment, dataset, checkpoint or setting does not exist, the file names what only the
/// user may name, two cells are equal, or the user stops the program.
pub fn study(
    file: &StudyFile,
    settings: &[String],
    resolver: &HomeResolver,
    control: &mut Control<'_>,
) -> Result<Study> {
    let (mut cells, mut inputs) = (vec![], Inputs::new(resolver));
    for combination in combinations(file, settings, resolver)? {
        control.check()?;
        let Combination { starts, condition, policy, all } = combination;
        let within = |error| within(&condition, &policy, error);
        let request = request(&all, &condition.name, &policy, resolver).map_err(within)?;
        let inputs = inputs.of(&request).map_err(within)?;
        let any_seed = policy.any_seed.clone();
        let trained_on_starts = trained_on_starts(&request, &inputs, resolver).map_err(within)?;
        let (starts, variables) = (starts.name, all.variables);
        cells.push(Cell { starts, variables, any_seed, trained_on_starts, request, inputs, sequential: false });
    }
    let study = Study {
        title: file.title.clone(),
        question: file.question.clone(),
        families: file.families.clone(),
        cells,
        until: None,
        ray: None,
        published: file.published.clone(),
        arguments: vec![],
    };
    study.check()?;
    study.check_names()?;
    Ok(study)
}

/// Checks what is known of the cells before their datasets exist: one cell of each policy and source of starts.
///
/// # Errors
/// As [`study`].
pub fn check(file: &StudyFile, settings: &[String], resolver: &HomeResolver) -> Result<()> {
    let mut seen = BTreeSet::new();
    for Combination { starts, condition, policy, all } in combinations(file, settings, resolver)? {
        if seen.insert([starts.name, policy.name.clone()]) {
            request(&all, &condition.name, &policy, resolver).map_err(|error| within(&condition, &policy, error))?;
        }
    }
    Ok(())
}

/// Names the tables of a cell in an error.
fn within(condition: &Variant, policy: &Variant, error: Error) -> Error {
    let places: Vec<&str> = [condition, policy].iter().map(|variant| variant.at.as_str()).collect();
    match error {
        Error::Interrupted => error,
        error if places.iter().all(|place| *place == OF_THE_COMMAND) => error,
        error => Error::config(
            format!("'{}' of '{}' ({})", condition.name, policy.name, places.join(", ")),
            error.to_string(),
            "correct the file of the study",
        ),
    }
}

/// Every combination of defaults, starts, conditions and policies, in this order.
fn combinations(file: &StudyFile, settings: &[String], resolver: &HomeResolver) -> Result<Vec<Combination>> {
    let defaults = file.defaults.with(settings)?;
    let env = defaults.option("env").map(|env| resolver.choose_env(env)?.env()).transpose()?;
    let space = env.as_ref().map(|env| &env.spec().variation_space);
    let mut budget = Budget::default();
    let mut expand = |tables: &[Table]| -> Result<Vec<Variant>> {
        let mut variants = vec![];
        for table in tables {
            variants.extend(table.variants(space, &mut budget)?);
            if variants.len() > Study::MAX_CELLS {
                let fix = format!("give at most {} cells", Study::MAX_CELLS);
                return Err(Error::config(table.at.clone(), "the tables up to this one make too many cells", fix));
            }
        }
        Ok(variants)
    };
    let (starts, conditions, policies) = (expand(&file.starts)?, expand(&file.conditions)?, expand(&file.policies)?);
    let defaults = expand(std::slice::from_ref(&defaults))?;
    let sizes = [&defaults, &starts, &conditions, &policies].map(Vec::len);
    let cells = sizes.into_iter().fold(1, usize::saturating_mul);
    if cells > Study::MAX_CELLS {
        let problem = format!(
            "{} defaults x {} starts x {} conditions x {} policies are {cells} cells",
            sizes[0], sizes[1], sizes[2], sizes[3]
        );
        return Err(Error::config("the study", problem, format!("give at most {} cells", Study::MAX_CELLS)));
    }
    for variants in [&defaults, &starts, &conditions, &policies] {
        let bytes: usize = variants.iter().map(Variant::size).sum();
        budget.take(bytes.saturating_mul(cells / variants.len().max(1)), "the study")?;
    }
    for policy in &policies {
        if let Some(name) = policy.starts.iter().find(|name| starts.iter().all(|starts| starts.name != **name)) {
            let names = starts.iter().map(|starts| starts.name.as_str());
            let problem = Error::unknown("source of starts", name, names, "name a table [[starts]] of the study");
            return Err(Error::config(policy.at.clone(), problem.to_string(), "correct the file"));
        }
    }
    let mut combinations = Vec::with_capacity(cells);
    for defaults in defaults {
        for starts in &starts {
            for condition in &conditions {
                let evaluated = |policy: &&Variant| policy.starts.is_empty() || policy.starts.contains(&starts.name);
                for policy in policies.iter().filter(evaluated) {
                    combinations.push(Combination {
                        all: Variant::combine(&[&defaults, starts, condition, policy]),
                        starts: starts.clone(),
                        condition: condition.clone(),
                        policy: policy.clone(),
                    });
                }
            }
        }
    }
    Ok(combinations)
}

/// Returns the options of the first cells, at most `most`.
///
/// # Errors
/// When a table or an option is invalid.
pub fn options(file: &StudyFile, most: usize, resolver: &HomeResolver) -> Result<Vec<EvalArgs>> {
    combinations(file, &[], resolver)?.iter().take(most).map(|combination| parsed(&combination.all)).collect()
}

/// The options of a cell.
fn parsed(all: &Variant) -> Result<EvalArgs> {
    let matches = EvalArgs::augment_args(Command::new("swm eval")).try_get_matches_from(all.arguments());
    let parsed = matches.and_then(|matches| EvalArgs::from_arg_matches(&matches));
    parsed.map_err(|error| {
        Error::config("the options of a cell", usage::on_one_line(&error), "`swm eval --help` describes the options")
    })
}

/// The request of a cell, with the names of the study.
fn request(all: &Variant, condition: &str, policy: &Variant, resolver: &HomeResolver) -> Result<EvalRequest> {
    let mut request = parsed(all)?.request(resolver, CapsuleStarts::Ignore)?;
    let [only] = &mut request.policies[..] else {
        let problem = format!("its options make {} policies, and a cell has one", request.policies.len());
        return Err(Error::config("the policy", problem, "give one policy and one solver; `each` makes several cells"));
    };
    // Reports recognise the floor by its name.
    if only.kind != PolicyKind::Random {
        policy.name.clone_into(&mut only.name);
    } else if policy.name != only.name && policy.at != OF_THE_COMMAND {
        let problem = format!("the random policy has the name '{}', and is always called '{}'", policy.name, only.name);
        return Err(Error::config("the policy", problem, format!("write name = \"{}\"", only.name)));
    }
    request.conditions.iter_mut().for_each(|only| condition.clone_into(&mut only.name));
    Ok(request)
}

/// Whether the policy of a request was trained on episodes that the starts come from: the split-leak check. `None` where this
/// is not known: without recorded starts or a checkpoint, and where the checkpoint was trained on another dataset, of which these
/// may be a part.
fn trained_on_starts(
    request: &EvalRequest,
    inputs: &BTreeMap<String, String>,
    resolver: &HomeResolver,
) -> Result<Option<bool>> {
    let (Some(given), StartsRequest::Dataset { held_out, .. }) = (checkpoint(request), &request.starts) else {
        return Ok(None);
    };
    let manifest = resolver.checkpoint(given)?.info()?.manifest;
    let same = manifest.hashes.get("dataset").zip(inputs.get("dataset")).is_some_and(|(a, b)| a == b);
    let held_out_of_training = [&manifest.config["data"]["hold_out"], &manifest.config["hold_out"]];
    let Some(holds_out) = held_out_of_training.into_iter().find_map(serde_json::Value::as_bool).filter(|_| same) else {
        return Ok(None);
    };
    // Training leaves out the validation and the test part of the default split.
    Ok(Some(match held_out {
        Some(HeldOut { part, split }) => !holds_out || *part == Part::Train || *split != Split::default(),
        None => true,
    }))
}

/// The checkpoint that a request names, if it does.
fn checkpoint(request: &EvalRequest) -> Option<&str> {
    request.policies.iter().find_map(|policy| policy.kind.checkpoint())
}

/// Hashes of datasets and weights, each computed once.
pub struct Inputs<'a> {
    resolver: &'a HomeResolver,
    known: BTreeMap<(&'static str, String), String>,
}

impl<'a> Inputs<'a> {
    /// Nothing is known yet.
    pub fn new(resolver: &'a HomeResolver) -> Self {
        Self { resolver, known: BTreeMap::new() }
    }

    /// Returns the hashes of the datasets and the weights that a request names.
    ///
    /// # Errors
    /// When one of them does not exist or is damaged.
    pub fn of(&mut self, request: &EvalRequest) -> Result<BTreeMap<String, String>> {
        let mut inputs = BTreeMap::new();
        if let StartsRequest::Dataset { dataset, .. } = &request.starts {
            let hash = self.hash("dataset", dataset, |resolver| resolver.dataset(dataset)?.content_hash())?;
            inputs.insert("dataset".to_owned(), hash);
        }
        if let Some(given) = checkpoint(request) {
            let hash = self.hash("weights", given, |resolver| Ok(resolver.checkpoint(given)?.info()?.weights))?;
            inputs.insert("weights".to_owned(), hash);
        }
        if let Some(dataset) = request.policies.iter().find_map(|policy| policy.kind.probe_dataset()) {
            let hash = self.hash("dataset", dataset, |resolver| resolver.dataset(dataset)?.content_hash())?;
            inputs.insert(PROBE_DATASET.to_owned(), hash);
        }
        Ok(inputs)
    }

    fn hash(
        &mut self,
        kind: &'static str,
        name: &str,
        compute: impl FnOnce(&HomeResolver) -> Result<String>,
    ) -> Result<String> {
        if let Some(hash) = self.known.get(&(kind, name.to_owned())) {
            return Ok(hash.clone());
        }
        let hash = compute(self.resolver)?;
        self.known.insert((kind, name.to_owned()), hash.clone());
        Ok(hash)
    }
}
