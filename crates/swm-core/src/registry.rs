//! [`Registry`]: a list of all implementations of one kind, such as environments or solvers. A row holds the id, the
//! constructor and the defaults of one implementation.

use crate::policy::Expert;
use crate::{Env, Error, Result};

/// A row of a registry.
pub trait Named {
    /// The id that users write.
    fn id(&self) -> &'static str;
}

/// A list of rows with unique ids.
#[derive(Clone, Copy)]
pub struct Registry<T: 'static> {
    /// The kind of the rows, for errors: "environment".
    pub kind: &'static str,
    /// A hint for errors, which names the command that lists the ids: "`swm envs` lists them".
    pub hint: &'static str,
    /// The rows.
    pub rows: &'static [T],
}

impl<T: Named> Registry<T> {
    /// The row of an id.
    ///
    /// # Errors
    /// When no row has that id; the error suggests similar ids.
    pub fn get(&self, id: &str) -> Result<&'static T> {
        self.rows
            .iter()
            .find(|row| row.id() == id)
            .ok_or_else(|| Error::unknown(self.kind, id, self.rows.iter().map(Named::id), self.hint))
    }
}

/// Concatenates two lists, for registries that several crates fill.
///
/// # Panics
/// When `N` differs from the total length, or the first list is empty.
pub const fn concat<T: Copy, const N: usize>(first: &[T], second: &[T]) -> [T; N] {
    assert!(
        first.len() + second.len() == N && !first.is_empty(),
        "N must be the total length of the two lists, and the first list must not be empty"
    );
    let mut all = [first[0]; N];
    let mut i = 0;
    while i < N {
        all[i] = if i < first.len() { first[i] } else { second[i - first.len()] };
        i += 1;
    }
    all
}

/// An option of an environment, such as its task. The option's value is chosen when the environment is made.
#[derive(Clone, Copy, Debug)]
pub struct EnvOption {
    /// The option's name, such as `task`.
    pub key: &'static str,
    /// The option's effect, in a sentence.
    pub summary: &'static str,
    /// The possible values; the first is the default.
    pub values: &'static [&'static str],
}

/// The value of each of an environment's options.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Choices(Vec<(&'static str, &'static str)>);

impl Choices {
    /// The value of an option.
    ///
    /// # Panics
    /// When the environment has no such option.
    pub fn get(&self, key: &str) -> &'static str {
        let chosen = self.0.iter().find(|(known, _)| *known == key);
        chosen.unwrap_or_else(|| panic!("the environment has no option {key}")).1
    }
}

/// A row of the registry of environments.
#[derive(Clone, Copy)]
pub struct EnvEntry {
    /// The environment's id, such as `swm/PushT-v1`.
    pub id: &'static str,
    /// The environment's task, in a sentence.
    pub summary: &'static str,
    /// The environment's options.
    pub options: &'static [EnvOption],
    /// The constructor. The [`crate::EnvSpec::id`] of the environment is [`EnvChoice::id`].
    pub make: fn(&EnvChoice) -> Result<Box<dyn Env>>,
    /// The environment's experts; the first is the default.
    pub experts: &'static [ExpertEntry],
}

impl Named for EnvEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

impl EnvEntry {
    /// Makes the environment with the default of every option.
    ///
    /// # Errors
    /// When a library or asset is missing on this machine.
    pub fn env(&self) -> Result<Box<dyn Env>> {
        EnvChoice::from(self).env()
    }
}

/// A row of the registry of environments, with chosen values of the environment's options.
#[derive(Clone)]
pub struct EnvChoice {
    /// The row.
    pub entry: EnvEntry,
    /// The chosen values of the environment's options.
    pub choices: Choices,
}

impl From<&EnvEntry> for EnvChoice {
    fn from(entry: &EnvEntry) -> Self {
        Self {
            entry: *entry,
            choices: Choices(entry.options.iter().map(|option| (option.key, option.values[0])).collect()),
        }
    }
}

impl EnvChoice {
    /// The id with the options that differ from their defaults, as [`Registry::choose`] reads it.
    pub fn id(&self) -> String {
        let mut id = self.entry.id.to_owned();
        for (option, (key, value)) in self.entry.options.iter().zip(&self.choices.0) {
            if *value != option.values[0] {
                id.push_str(&format!(",{key}={value}"));
            }
        }
        id
    }

    /// Makes the environment.
    ///
    /// # Errors
    /// When a library or asset is missing on this machine.
    pub fn env(&self) -> Result<Box<dyn Env>> {
        (self.entry.make)(self)
    }
}

impl Registry<EnvEntry> {
    /// Parses `ID` or `ID,option=value,…`.
    ///
    /// # Errors
    /// When there is no such environment, option or value (the error lists the valid names), or an option is given
    /// twice.
    pub fn choose(&self, text: &str) -> Result<EnvChoice> {
        let mut parts = text.split(',');
        let mut chosen = EnvChoice::from(self.get(parts.next().unwrap_or_default())?);
        let mut given: Vec<Option<&str>> = vec![None; chosen.entry.options.len()];
        for part in parts {
            let (key, value) = part.split_once('=').unwrap_or((part, ""));
            let options = chosen.entry.options;
            let keys = || options.iter().map(|option| option.key);
            let index = keys().position(|known| known == key).ok_or_else(|| {
                let id = chosen.entry.id;
                let known: Vec<&str> = keys().collect();
                let hint = match options.is_empty() {
                    true => format!("{id} has no options"),
                    false => format!("the options of {id} are {}; write {id},option=value", known.join(", ")),
                };
                Error::unknown("environment option", key, keys(), hint)
            })?;
            if let Some(first) = given[index].replace(part) {
                return Err(Error::twice(format!("option of {}", chosen.entry.id), first, part));
            }
            let values = options[index].values;
            let value = values.iter().find(|known| **known == value).ok_or_else(|| {
                let hint = format!("{key} of {} is one of {}", chosen.entry.id, values.join(", "));
                Error::unknown("option value", value, values.iter().copied(), hint)
            })?;
            chosen.choices.0[index].1 = value;
        }
        // Experts of other tasks are none of this environment.
        if !chosen.entry.experts.iter().all(|expert| expert.plays(&chosen.choices)) {
            chosen.entry.experts = &[];
        }
        Ok(chosen)
    }
}

/// A row of an environment's experts.
#[derive(Clone, Copy)]
pub struct ExpertEntry {
    /// The expert's name, such as `expert` or `weak`.
    pub id: &'static str,
    /// The expert's behaviour, in a sentence.
    pub summary: &'static str,
    /// The values of the option `task` whose rewards the expert earns; empty for an expert that reaches the goals of every task.
    pub tasks: &'static [&'static str],
    /// The constructor of an expert for one environment.
    pub make: fn() -> Box<dyn Expert>,
}

impl ExpertEntry {
    /// Whether the expert plays an environment with these options.
    fn plays(&self, choices: &Choices) -> bool {
        let task = choices.0.iter().find(|(key, _)| *key == "task");
        self.tasks.is_empty() || task.is_some_and(|(_, task)| self.tasks.contains(task))
    }
}

impl Named for ExpertEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}
