//! Progress of long runs on standard error: a bar on a terminal, elsewhere a plain line every ten seconds.

use super::results_tables::percent;
use super::{Context, eprint};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal as _;
use std::sync::Arc;
use std::time::{Duration, Instant};
use swm_core::results::Proportion;
use swm_core::run::{Control, Event, Progress};
use swm_core::text::printable;

/// The time between plain lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);

/// The number of metrics of a model in a progress message.
const SHOWN_METRICS: usize = 4;

/// Returns a control that shows the stages of a run and stops the run at Ctrl-C.
pub fn control(context: &Context) -> Control<'static> {
    let mut stages = Stages::default();
    Control::new().with_interrupt(Arc::clone(&context.interrupt)).with_events(move |event| match event {
        Event::Started(stage) => stages.start(stage.name, stage.subject.join(", "), stage.total),
        Event::Progress(progress) => {
            let stage = stages.current(progress.stage, progress.total);
            let message = stage.message(&progress);
            stage.update(progress.done, message);
        }
        Event::Finished { stage, metrics } => {
            let subject = stages.finish(stage);
            if let Some(success) = success_rate(metrics) {
                print_summary(stage, &format!("{subject}: {success}"));
            }
        }
        Event::Log(line) => {
            let print = || eprint(&format!("{line}\n"));
            stages.0.last().map_or_else(print, |stage| stage.bar.suspend(print));
        }
        _ => {}
    })
}

/// The stages that have started and not finished, the innermost last: a row of a study is a training or an evaluation with
/// stages of its own. Only the innermost is shown.
#[derive(Default)]
struct Stages(Vec<StageDisplay>);

impl Stages {
    fn start(&mut self, name: &'static str, subject: String, total: usize) {
        if let Some(outer) = self.0.last() {
            outer.bar.set_draw_target(ProgressDrawTarget::hidden());
        }
        self.0.push(StageDisplay::new(name, subject, total));
    }

    /// Returns the stage of this name, without the stages inside it, which have ended. A stage that did not start starts.
    fn current(&mut self, name: &'static str, total: usize) -> &mut StageDisplay {
        if let Some(place) = self.0.iter().rposition(|stage| stage.name == name) {
            self.0.truncate(place + 1);
        } else {
            self.start(name, String::new(), total);
        }
        let last = self.0.len() - 1;
        let stage = &mut self.0[last];
        if stage.bar.is_hidden() {
            stage.bar.set_draw_target(draw_target());
        }
        stage
    }

    /// Clears a stage and those inside it, and returns its subject.
    fn finish(&mut self, name: &str) -> String {
        let Some(place) = self.0.iter().rposition(|stage| stage.name == name) else { return String::new() };
        let subject = std::mem::take(&mut self.0[place].subject);
        self.0.truncate(place);
        subject
    }
}

/// Where bars are drawn: nowhere unless standard error is a terminal.
fn draw_target() -> ProgressDrawTarget {
    if std::io::stderr().is_terminal() { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() }
}

/// Prints the summary of a finished stage.
pub fn print_summary(stage: &str, message: &str) {
    eprint(&format!("{stage:>9}: {message}\n"));
}

/// Returns a speed in steps per second.
pub fn steps_per_second(steps: f64, elapsed: Duration) -> String {
    format!("{:.0} steps/s", steps / elapsed.as_secs_f64().max(1e-9))
}

/// The display of one stage; dropping it clears the bar.
pub struct StageDisplay {
    name: &'static str,
    subject: String,
    bar: ProgressBar,
    start: Instant,
    /// The time of the last plain line; `None` on a terminal.
    last_line: Option<Instant>,
}

impl StageDisplay {
    /// Shows a stage with `total` units of work.
    pub fn new(name: &'static str, subject: String, total: usize) -> Self {
        let is_terminal = std::io::stderr().is_terminal();
        let bar = ProgressBar::with_draw_target(Some(total as u64), draw_target());
        if let Ok(style) =
            ProgressStyle::with_template("{prefix:>9} {bar:20.cyan/dim} {pos}/{len} eta {eta} {wide_msg}")
        {
            bar.set_style(style.progress_chars("━╸─"));
        }
        bar.set_prefix(name);
        let start = Instant::now();
        Self { name, subject, bar, start, last_line: (!is_terminal).then_some(start) }
    }

    /// Shows that `done` units of work are done, with a message.
    pub fn update(&mut self, done: usize, message: String) {
        if let Some(last) = &mut self.last_line
            && last.elapsed() >= PLAIN_INTERVAL
        {
            *last = Instant::now();
            let total = self.bar.length().unwrap_or_default();
            eprint(&format!("{}: {done}/{total} {message}\n", self.name));
        }
        self.bar.set_position(done as u64);
        self.bar.set_message(printable(&message).into_owned());
    }

    fn message(&self, progress: &Progress<'_>) -> String {
        match progress.stage {
            "collect" => steps_per_second(progress.metric("steps").unwrap_or_default(), self.start.elapsed()),
            "train" => training_message(progress),
            _ => self.subject.clone(),
        }
    }
}

impl Drop for StageDisplay {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

/// Formats the model's first metrics, the validation metric, and the speed of the loader.
fn training_message(progress: &Progress<'_>) -> String {
    // The metrics of the model precede the metrics of the training loop.
    let is_of_loop = |name: &str| ["validation_loss", "evaluation_return", "lr"].contains(&name);
    let model = progress.metrics.iter().take_while(|(name, _)| !is_of_loop(name)).take(SHOWN_METRICS);
    let model: Vec<String> = model.map(|(name, value)| format!("{name} {value:.4}")).collect();
    let held_out = progress.metric("validation_loss").or(progress.metric("evaluation_return"));
    let held_out = held_out.map_or(String::new(), |value| format!(", held out {value:.4}"));
    let clips_per_second = progress.metric("clips_per_second").unwrap_or_default();
    let wait = 100.0 * progress.metric("data_wait").unwrap_or_default();
    format!("{}{held_out}, {clips_per_second:.0} clips/s, waits {wait:.0} %", model.join(" "))
}

/// Formats the success rate of a finished evaluation; `None` for other stages.
fn success_rate(metrics: &[(&str, f64)]) -> Option<String> {
    let metric = |name| metrics.iter().find(|(known, _)| *known == name).map(|(_, value)| *value);
    let [successes, n] = [metric("successes")?, metric("episodes")?].map(|count| count as usize);
    let (low, high) = (metric("success_low")?, metric("success_high")?);
    Some(percent(&Proportion { low, high, ..Proportion::wilson(successes, n) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn training_message_shows_the_losses_before_the_speed() {
        let metrics =
            [("loss", 0.5), ("validation_loss", 0.25), ("lr", 1e-3), ("clips_per_second", 12.0), ("data_wait", 0.5)];
        let progress = Progress { stage: "train", done: 1, total: 2, unit: "steps", metrics: &metrics };
        assert_eq!(training_message(&progress), "loss 0.5000, held out 0.2500, 12 clips/s, waits 50 %");
    }

    #[test]
    fn a_stage_inside_another_keeps_counts_of_its_own() {
        let mut stages = Stages::default();
        stages.start("study", "drift".to_owned(), 4);
        stages.start("evaluate", "actor".to_owned(), 20);
        stages.current("evaluate", 20).update(20, String::new());
        assert_eq!(stages.finish("evaluate"), "actor");
        let study = stages.current("study", 4);
        study.update(1, String::new());
        assert_eq!((study.bar.position(), study.bar.length()), (1, Some(4)));
        // A stage that failed did not finish.
        stages.start("train", String::new(), 9);
        assert_eq!((stages.finish("study").as_str(), stages.0.len()), ("drift", 0));
        assert_eq!(stages.finish("study"), "");
    }

    #[test]
    fn success_rate_requires_counts_of_successes_and_episodes() {
        assert_eq!(success_rate(&[("loss", 0.5)]), None);
        let metrics = |n| [("successes", n / 2.0), ("episodes", n), ("success_low", 0.125), ("success_high", 0.875)];
        assert_eq!(success_rate(&metrics(2.0)).as_deref(), Some("50 % [12, 88]"));
        assert_eq!(success_rate(&metrics(0.0)).as_deref(), Some("–"), "of no episodes there is no rate");
    }
}
