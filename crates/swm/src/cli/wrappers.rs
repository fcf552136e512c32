//! `swm wrappers`: lists the visual wrappers; and the arguments of commands that apply wrappers.

use super::{emit, emit_json, table};
use crate::resolver::check_wrapper;
use clap::Args;
use serde_json::{Map, Value};
use std::borrow::Cow;
use swm_core::{Origin, Result};
use swm_envs::wrappers::{GoalFrame, Stack, WRAPPERS, read};
use swm_eval::Choice;

/// The wrappers of an environment's frames.
#[derive(Args, Clone, Default)]
pub struct WrapperArgs {
    /// Wrapper of frames, such as noise,std=8; several apply in order
    ///
    /// `swm wrappers` lists them.
    #[arg(long = "wrapper", value_name = "NAME[,KEY=VALUE…]")]
    pub wrappers: Vec<String>,
    /// Apply the wrappers to the frame of the goal, too
    #[arg(long, requires = "wrappers")]
    pub wrap_goal: bool,
}

impl WrapperArgs {
    /// Returns the wrappers with their settings, in order. `origin` is who named them.
    ///
    /// # Errors
    /// When a wrapper or a setting is unknown or invalid, a file cannot be read, or a file named a wrapper that reads
    /// files.
    pub fn choices(&self, origin: &Origin) -> Result<Vec<Choice>> {
        let choices = self.wrappers.iter().map(|text| {
            let (entry, settings) = read(text)?;
            check_wrapper(origin, entry)?;
            entry.make(&settings)?;
            Ok(Choice { id: entry.id.to_owned(), settings: settings.into_iter().collect() })
        });
        choices.collect()
    }

    /// Returns the stack of wrappers, and whether it applies to the frame of the goal.
    ///
    /// # Errors
    /// As [`WrapperArgs::choices`].
    pub fn stack(&self) -> Result<(Stack, GoalFrame)> {
        let goal = if self.wrap_goal { GoalFrame::Wrapped } else { GoalFrame::Clean };
        Ok((Stack::parse(&self.wrappers)?, goal))
    }
}

/// Returns the value of a setting as the command line writes it; a list is joined by `/`.
pub fn shown(value: &Value) -> Cow<'_, str> {
    match value {
        Value::String(text) => Cow::Borrowed(text),
        Value::Array(values) => Cow::Owned(values.iter().map(shown).collect::<Vec<_>>().join("/")),
        other => Cow::Owned(other.to_string()),
    }
}

/// Lists the wrappers and their settings.
pub fn wrappers(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all: Map<String, Value> = WRAPPERS.rows.iter().map(|row| (row.id.to_owned(), row.describe())).collect();
        return emit_json(&all);
    }
    let rows = WRAPPERS.rows.iter().map(|row| {
        let parameters = row.parameters.iter().map(|parameter| {
            let default = match parameter.default_value() {
                Value::Null => "…".to_owned(),
                value => shown(&value).into_owned(),
            };
            format!("{}={default} ({})", parameter.name, parameter.domain)
        });
        vec![row.id.to_owned(), row.summary.to_owned(), parameters.collect::<Vec<_>>().join("\n")]
    });
    emit(&table(&["wrapper", "description", "setting=default (valid values)"], rows));
    Ok(())
}
