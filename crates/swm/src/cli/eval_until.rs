//! `swm eval --until`: an evaluation that its results end.

use super::Context;
use super::eval::{run_options, write_json};
use super::output_folder::{self, RESULTS};
use super::progress::control;
use super::run_record;
use crate::resolver::HomeResolver;
use std::path::{Path, PathBuf};
use swm_core::results::Until;
use swm_core::{Error, Result, Results, files};
use swm_eval::EvalRequest;

/// Evaluates until the rule is met, and writes `results.json` after every stage. With `resume`, continues the results in the
/// folder, if there are some. `videos` is the number of recorded episodes of each run.
pub fn run(
    request: &EvalRequest,
    (until, resume): (Until, bool),
    resolver: &HomeResolver,
    envs: usize,
    (output, videos): (&Path, usize),
    context: &Context,
) -> Result<(Results, PathBuf)> {
    let (is_new, file) = (!output.exists(), output.join(RESULTS));
    let _lock = output_folder::claim(output, &[RESULTS])?;
    run_record::check(output)?;
    let earlier = (resume && file.exists()).then(|| swm_report::read_results(&file)).transpose()?;
    let options = run_options(envs, (videos > 0).then(|| (output.to_owned(), videos)), context);
    // Continuing adds a command line to the record, once there are results.
    let mut is_recorded = false;
    let mut keep = |results: &Results| {
        if !is_recorded {
            output_folder::delete_traces(output)?;
        }
        write_json(&file, results)?;
        if !std::mem::replace(&mut is_recorded, true) {
            run_record::write(output, resume)?;
        }
        Ok(())
    };
    let results = request.run_until(until, earlier, resolver, &options, &mut keep, &mut control(context));
    if results.is_err() && is_new {
        files::remove_empty_folder(output)?;
    }
    let results = results?;
    write_json(&file, &results)?;
    Ok((results, file))
}

/// Refuses an evaluation of a fixed number of episodes in the folder of one that its results end.
///
/// # Errors
/// When the folder has such results.
pub fn refuse_fixed(output: &Path) -> Result<()> {
    let file = output.join(RESULTS);
    let found = if file.exists() { swm_report::read_results(&file).ok() } else { None };
    match found.and_then(|results| results.stopping) {
        Some(stopping) => {
            let problem = format!("holds results that ran with --until {stopping}");
            let fix = "intervals for a fixed number of episodes do not hold for these starts: give --until again, or another \
                       folder with --output and another --seed";
            Err(Error::config(output.display().to_string(), problem, fix))
        }
        None => Ok(()),
    }
}
