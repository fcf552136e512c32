//! Errors in the arguments, as the command line prints them: clap's, in the words of this program.

use super::output::is_coloured;
use std::error::Error as _;
use std::net::AddrParseError;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};
use swm_core::Error;

/// Returns the text of an error in the arguments, in colours if standard error has them.
pub fn coloured(error: &clap::Error) -> String {
    let text = error.render();
    let text = if is_coloured(&std::io::stderr()) { text.ansi().to_string() } else { text.to_string() };
    in_words(error, text)
}

/// Returns the text of an error in the arguments, without colours.
pub fn plain(error: &clap::Error) -> String {
    in_words(error, error.render().to_string())
}

/// Returns the text of an error in the arguments on one line, without the usage that follows it.
pub fn on_one_line(error: &clap::Error) -> String {
    let text = plain(error);
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let mut words = String::new();
    for line in lines.take_while(|line| !line.starts_with("Usage") && !line.starts_with("For more")) {
        words.push_str(if words.is_empty() {
            ""
        } else if words.ends_with(':') {
            " "
        } else {
            "; "
        });
        words.push_str(line);
    }
    words.trim_start_matches("error: ").to_owned()
}

/// Replaces the reason that a library gives for a refused value.
fn in_words(error: &clap::Error, mut text: String) -> String {
    if let Some(source) = error.source()
        && let Some(words) = reason(source)
        && let Some(start) = text.rfind(&source.to_string())
    {
        text.replace_range(start..start + source.to_string().len(), &words);
    }
    text
}

/// The reason in our words. What an error of this engine is about has been named before.
fn reason(source: &(dyn std::error::Error + 'static)) -> Option<String> {
    if let Some(Error::Config { problem, fix, .. }) = source.downcast_ref() {
        return Some(format!("{problem}; {fix}"));
    }
    if let Some(error) = source.downcast_ref::<ParseIntError>() {
        let is_large = *error.kind() == IntErrorKind::PosOverflow;
        return Some(
            if is_large { "the number is too large" } else { "expected a whole number of at least 0" }.to_owned(),
        );
    }
    if source.is::<ParseFloatError>() {
        return Some("expected a number".to_owned());
    }
    if source.is::<AddrParseError>() {
        return Some("expected an IP address, such as 127.0.0.1".to_owned());
    }
    // Clap's ranges, such as `0..=65535`.
    let text = source.to_string();
    let (low, high) = text.split_once(" is not in ")?.1.split_once("..=")?;
    Some(format!("expected a whole number from {low} to {high}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::OsString;

    #[test]
    fn missing_arguments_are_named_on_one_line() {
        let words = ["swm", "collect", "swm/TwoRoom-v1"].map(OsString::from).into_iter().collect();
        let error = super::super::parse(words).err().expect("no output");
        let text = on_one_line(&error);
        assert!(text.contains("not provided: --output") && !text.contains("error:"), "{text}");
    }

    #[test]
    fn refused_values_are_explained_in_words() {
        for (command, message) in [
            ("collect e -o x --seed y", "invalid value 'y' for '--seed <SEED>': expected a whole number of at least 0"),
            ("collect e -o x --seed -1", "'--seed <SEED>': expected a whole number of at least 0"),
            ("collect e -o x --seed 99999999999999999999", "'--seed <SEED>': the number is too large"),
            ("collect e -o x --action-noise y", "'--action-noise <STD>': expected a number"),
            ("collect e -o x --episodes 0", "'0' is not a whole number from 1 to"),
            (
                "collect e -o x --codec jpeg --quality 101",
                "'--quality <QUALITY>': expected a whole number from 1 to 100",
            ),
            ("lab --port 99999", "expected a whole number from 0 to 65535"),
            ("lab --listen here", "expected an IP address, such as 127.0.0.1"),
            ("eval random --until ci=0", "for '--until <RULE>': 'ci=0' is no rule; write ci=5"),
            ("envs --renderer gl", "for '--renderer <NAME>': there is no 'gl'; choose auto, egl or cpu"),
        ] {
            let words = std::iter::once("swm").chain(command.split(' ')).map(OsString::from).collect();
            let error = super::super::parse(words).err().expect(command);
            let text = plain(&error);
            assert!(text.contains(message), "{command}: {text}");
        }
    }
}
