//! `swm completions` and `swm man`: what a shell and `man` need to know about the commands; and the groups in which
//! `swm --help` lists them.

use super::{Cli, as_texts, emit, emit_json, output_folder};
use clap::{Arg, Args, Command, CommandFactory as _};
use clap_complete::Shell;
use clap_mangen::Man;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// The commands in the order in which the help lists them.
const GROUPS: &[(&str, &[&str])] = &[
    (
        "Data",
        &[
            "envs", "fovs", "frame", "wrappers", "collect", "datasets", "inspect", "preview", "convert", "export",
            "doctor", "formats",
        ],
    ),
    ("Train", &["models", "devices", "train", "plot", "recipes", "zoo", "checkpoints", "pull", "push", "probe"]),
    ("Evaluate", &["eval", "solvers", "reproduce", "report", "study", "autopsy", "leaderboard"]),
    ("System", &["demo", "lab", "assets", "bench", "completions", "man"]),
];

/// Arguments of `swm completions`.
#[derive(Args)]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Arguments of `swm man`.
#[derive(Args)]
pub struct ManArgs {
    /// Folder of the pages
    #[arg(short, long, default_value = "man", value_name = "DIR")]
    output: PathBuf,
}

/// Returns the declarations of all commands, with a help that lists them in groups.
pub fn command() -> Command {
    let command = with_negative_numbers(Cli::command());
    let mut groups = String::new();
    for (group, names) in GROUPS {
        let _ = write!(groups, "\n{group}:\n");
        for name in *names {
            let about = command.find_subcommand(name).and_then(Command::get_about);
            let about = about.map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(groups, "  {name:<12} {about}");
        }
    }
    command.help_template(format!(
        "{{about}}\n\n{{usage-heading}} {{usage}}\n{groups}\n`swm help COMMAND` explains a command.\n\n\
         Options:\n{{options}}{{after-help}}"
    ))
}

/// Lets every option take a negative number, so that its own check refuses it, and `-1` is not taken for an option.
fn with_negative_numbers(command: Command) -> Command {
    let takes_value = |arg: &Arg| !arg.is_positional() && arg.get_action().takes_values();
    let command = command.mut_args(|arg| if takes_value(&arg) { arg.allow_negative_numbers(true) } else { arg });
    command.mut_subcommands(with_negative_numbers)
}

/// Prints the completions of a shell.
pub fn completions(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut script = vec![];
    clap_complete::generate(args.shell, &mut command(), "swm", &mut script);
    emit(&String::from_utf8(script)?);
    Ok(())
}

/// Writes a manual page for each command.
pub fn man(args: &ManArgs, as_json: bool) -> anyhow::Result<()> {
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    let mut pages = vec![];
    add_pages(&command, "swm", &mut pages)?;
    let _lock = output_folder::claim(&args.output, &[])?;
    let paths: Vec<PathBuf> = pages.iter().map(|(name, _)| args.output.join(format!("{name}.1"))).collect();
    paths.iter().try_for_each(|path| files::check_own(path, is_own))?;
    let is_page = |name: &str| pages.iter().any(|(page, _)| name.strip_suffix(".1") == Some(page.as_str()));
    files::delete_temporary(&args.output, is_page)?;
    for ((_, text), path) in pages.iter().zip(&paths) {
        files::write(path, text)?;
    }
    if as_json {
        return emit_json(&json!({"files": as_texts(&paths)}));
    }
    emit(&paths.iter().map(|path| format!("{}\n", path.display())).collect::<String>());
    Ok(())
}

/// Appends the pages of a command and of its subcommands, named like `swm-study-run`.
fn add_pages(command: &Command, name: &str, pages: &mut Vec<(String, Vec<u8>)>) -> Result<()> {
    let mut text = vec![];
    let page = Man::new(command.clone().display_name(name.to_owned())).title(name.to_owned());
    page.render(&mut text).map_err(|error| Error::external("writing a manual page", error))?;
    pages.push((name.to_owned(), text));
    for subcommand in command.get_subcommands().filter(|subcommand| subcommand.get_name() != "help") {
        add_pages(subcommand, &format!("{name}-{}", subcommand.get_name()), pages)?;
    }
    Ok(())
}

/// Returns whether a file is a manual page of this program.
fn is_own(path: &Path) -> bool {
    const MAX_BYTES: u64 = 1 << 20;
    let text = files::read(path, MAX_BYTES).unwrap_or_default();
    text.windows(7).any(|part| part == b".TH swm")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_is_in_one_group() {
        let mut listed: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        listed.sort_unstable();
        let command = Cli::command();
        let mut known: Vec<&str> = command.get_subcommands().map(Command::get_name).collect();
        known.sort_unstable();
        assert_eq!(listed, known);
        let help = super::command().render_help().to_string();
        assert!(help.contains("\nTrain:\n  models       List the models"), "{help}");
        let groups = help.split("Options:").next().unwrap_or_default();
        assert!(groups.lines().all(|line| line.chars().count() <= 80), "{help}");
    }

    #[test]
    fn manual_pages_are_recognised() {
        let mut command = Cli::command().disable_help_subcommand(true);
        command.build();
        let mut pages = vec![];
        add_pages(&command, "swm", &mut pages).expect("the pages");
        assert!(pages.iter().any(|(name, _)| name == "swm-study-run"));
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("swm.1");
        std::fs::write(&path, &pages[0].1).expect("writing a page");
        assert!(is_own(&path));
    }
}
