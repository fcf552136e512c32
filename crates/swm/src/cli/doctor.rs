//! `swm doctor`: finds the defects of a dataset and the models it can train, and writes the intact episodes
//! to a new dataset.

use super::convert::{self, TargetArgs};
use super::progress::{control, print_summary};
use super::{Context, emit, emit_json, table};
use crate::home;
use clap::Args;
use serde_json::json;
use std::time::Instant;
use swm_data::ConvertMode;
use swm_data::doctor::{Diagnosis, Finding, Severity, examine, open_damaged, repair};

/// Arguments of `swm doctor`.
#[derive(Args)]
pub struct DoctorArgs {
    /// The dataset: a path, a URI or a name
    dataset: String,
    /// Write the episodes without a problem to a new dataset
    #[arg(long, value_name = "TARGET")]
    repair: Option<String>,
    #[command(flatten)]
    target: TargetArgs,
}

/// Examines a dataset, and repairs it on request. Fails when there are problems that are not repaired.
pub fn doctor(args: &DoctorArgs, context: &Context) -> anyhow::Result<()> {
    let name = &args.dataset;
    let target =
        args.repair.as_deref().map(|target| home::target(target, args.target.format.as_deref())).transpose()?;
    let (reader, lost) = match home::find_dataset(name).and_then(|location| open_damaged(&location)) {
        Ok(opened) => opened,
        Err(error) if error.is_usage() => return Err(error.into()),
        Err(error) => {
            if context.json {
                let finding = json!({"severity": "problem", "what": error.to_string(), "episodes": []});
                emit_json(&json!({"problems": 1, "findings": [finding]}))?;
            }
            return Err(anyhow::Error::new(error).context(format!("{name} cannot be opened")));
        }
    };
    let mut diagnosis = examine(&*reader, &swm_models::dataset_requirements()?, &mut control(context))?;
    diagnosis.add_losses(lost);
    print_summary("examine", &format!("{} episodes, {} rows", diagnosis.episodes, diagnosis.rows));
    let mut repaired = None;
    if !context.json {
        emit(&report(&diagnosis));
    }
    if let Some(target) = &target {
        let start = Instant::now();
        let options = args.target.options(ConvertMode::Resume)?;
        let converted = repair(&reader, &diagnosis, target, &options, &mut control(context))?;
        if !context.json {
            emit(&convert::describe(&converted, target, start.elapsed().as_secs_f64()));
        }
        repaired = Some(converted);
    }
    let problems = diagnosis.problems();
    if context.json {
        let mut found = json!(diagnosis);
        found["problems"] = json!(problems);
        found["repaired"] = json!(repaired);
        emit_json(&found)?;
    }
    if problems > 0 && repaired.is_none() {
        anyhow::bail!("{name} has problems; `swm doctor {name} --repair TARGET` writes the intact episodes");
    }
    Ok(())
}

/// Returns the findings and a table of models.
fn report(diagnosis: &Diagnosis) -> String {
    let mut text = String::new();
    for finding in &diagnosis.findings {
        let severity = if finding.severity == Severity::Problem { "problem" } else { "note" };
        text += &format!("{severity:>9}: {}{}\n", finding.what, episodes_of(finding));
    }
    if diagnosis.problems() == 0 {
        text += "       no problems\n";
    } else {
        text += &format!("   intact: {} of {} episodes\n", diagnosis.intact.len(), diagnosis.episodes);
    }
    let models = diagnosis.models.iter().map(|fit| {
        let answer = if fit.fits() { format!("yes, on {} episodes", fit.episodes) } else { fit.missing.join("; ") };
        vec![fit.model.to_owned(), answer]
    });
    text + "\n" + &table(&["model", "trainable"], models)
}

/// Returns the first few affected episodes.
fn episodes_of(finding: &Finding) -> String {
    const SHOWN: usize = 8;
    let shown: Vec<String> = finding.episodes.iter().take(SHOWN).map(usize::to_string).collect();
    match finding.episodes.len() {
        0 => String::new(),
        1 => format!(" (episode {})", shown[0]),
        count if count <= SHOWN => format!(" (episodes {})", shown.join(", ")),
        count => format!(" (episodes {} and {} more)", shown.join(", "), count - SHOWN),
    }
}
