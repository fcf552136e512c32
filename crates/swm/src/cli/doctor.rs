//! `swm doctor`: what is wrong with a dataset, which models it can train, and a new dataset of what is sound.

use super::convert::{TargetArgs, control, words};
use super::{Context, complain, emit, emit_json, table};
use clap::Args;
use serde_json::json;
use std::time::Instant;
use swm::home;
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

/// Examines, and repairs on request. Fails when there are problems that are not repaired.
pub fn doctor(args: &DoctorArgs, context: &Context) -> anyhow::Result<()> {
    let name = &args.dataset;
    let (reader, lost) = match home::find_dataset(name).and_then(|location| open_damaged(&location)) {
        Ok(opened) => opened,
        Err(error) if error.is_usage() => return Err(error.into()),
        Err(error) => {
            if context.json {
                let what = error.to_string();
                emit_json(
                    &json!({"problems": 1, "findings": [{"severity": "problem", "what": what, "episodes": []}]}),
                )?;
            }
            return Err(anyhow::Error::new(error).context(format!("{name} cannot be opened")));
        }
    };
    let mut diagnosis = examine(&*reader, &swm_models::dataset_requirements()?, &mut control(context))?;
    diagnosis.add_losses(lost);
    complain(&format!("{:>9}: {} episodes, {} rows\n", "examine", diagnosis.episodes, diagnosis.rows));
    let mut repaired = None;
    if !context.json {
        emit(&report(&diagnosis));
    }
    if let Some(target) = &args.repair {
        let target = home::target(target, args.target.format.as_deref())?;
        let begun = Instant::now();
        let options = args.target.options(ConvertMode::Resume);
        let converted = repair(&reader, &diagnosis, &target, &options, &mut control(context))?;
        if !context.json {
            emit(&words(&converted, &target, begun.elapsed().as_secs_f64()));
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
        anyhow::bail!("{name} has problems; `swm doctor {name} --repair TARGET` writes what is sound");
    }
    Ok(())
}

/// What was found, in words.
fn report(diagnosis: &Diagnosis) -> String {
    let mut text = String::new();
    for finding in &diagnosis.findings {
        let severity = if finding.severity == Severity::Problem { "problem" } else { "note" };
        text += &format!("{severity:>9}: {}{}\n", finding.what, places(finding));
    }
    if diagnosis.problems() == 0 {
        text += "       no problems\n";
    } else {
        text += &format!("    sound: {} of {} episodes\n", diagnosis.sound.len(), diagnosis.episodes);
    }
    let models = diagnosis.models.iter().map(|fit| {
        let can = if fit.fits() { format!("yes, on {} episodes", fit.episodes) } else { fit.missing.join("; ") };
        vec![fit.model.to_owned(), can]
    });
    text + "\n" + &table(&["model", "can be trained"], models)
}

/// In which episodes, the first few of them.
fn places(finding: &Finding) -> String {
    const FEW: usize = 8;
    let few: Vec<String> = finding.episodes.iter().take(FEW).map(usize::to_string).collect();
    match finding.episodes.len() {
        0 => String::new(),
        1 => format!(" (episode {})", few[0]),
        more if more <= FEW => format!(" (episodes {})", few.join(", ")),
        more => format!(" (episodes {} and {} more)", few.join(", "), more - FEW),
    }
}
