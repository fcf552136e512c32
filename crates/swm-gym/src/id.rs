//! [`TrustedId`]: the id of a Gymnasium environment that may be made.

use std::collections::BTreeMap;
use swm_core::{Error, Origin, Result};

/// The id of a Gymnasium environment and its arguments: `ID` or `ID,key=value,…`. Making an environment requires a value
/// of this type, so that the text of a file reaches no import.
#[derive(Clone, Debug)]
pub struct TrustedId {
    text: String,
    id: String,
    options: BTreeMap<String, String>,
}

impl TrustedId {
    /// Parses an id. A file may choose an id that is registered with Gymnasium, with numbers and plain words as
    /// arguments. Only the user may choose a module (`my_envs:Maze-v0`), a render mode, which can open a window, and other
    /// arguments, which can be the names of files, modules and classes.
    ///
    /// # Errors
    /// When the text has another form, or a file chose an id that only the user may choose.
    pub fn new(text: &str, origin: &Origin) -> Result<Self> {
        let (id, options) = parse(text)?;
        let check = |effect: &str| {
            origin.check_user(&format!("the environment '{text}'"), effect, Some(&format!("--env '{text}'")))
        };
        if id.contains(':') {
            check("which imports a Python module")?;
        }
        if let Some((key, value)) = options.iter().find(|(_, value)| !is_plain(value)) {
            check(&format!("whose argument {key}={value} is neither a number nor a plain word"))?;
        }
        if let Some(mode) = options.get("render_mode").filter(|mode| *mode != "rgb_array") {
            check(&format!("whose argument render_mode={mode} can open a window"))?;
        }
        Ok(Self { text: text.to_owned(), id: id.to_owned(), options })
    }

    /// The whole text.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The id, without arguments.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The arguments of `gymnasium.make`, as texts.
    pub(crate) fn options(&self) -> &BTreeMap<String, String> {
        &self.options
    }
}

/// Whether an argument consists of numbers and words, separated by commas, brackets and spaces.
fn is_plain(value: &str) -> bool {
    let is_word = |part: &str| part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    let mut parts = value.split([',', '(', ')', '[', ']', ' ']);
    parts.all(|part| is_word(part) || part.parse::<f64>().is_ok())
}

/// Splits a text into id and arguments. Commas inside brackets and quotes belong to a value.
fn parse(text: &str) -> Result<(&str, BTreeMap<String, String>)> {
    let mut parts = vec![];
    let (mut start, mut depth, mut quote) = (0, 0_i32, None);
    for (at, c) in text.char_indices() {
        match (quote, c) {
            (Some(open), _) if c == open => quote = None,
            (Some(_), _) => {}
            (None, '\'' | '"') => quote = Some(c),
            (None, '(' | '[' | '{') => depth += 1,
            (None, ')' | ']' | '}') => depth -= 1,
            (None, ',') if depth == 0 => {
                parts.push(&text[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    let id = parts[0];
    let wrong = |problem: String| Error::config(format!("environment '{text}'"), problem, "write ID or ID,key=value,…");
    if id.is_empty() {
        return Err(wrong("it has no id".to_owned()));
    }
    let mut options = BTreeMap::new();
    for part in &parts[1..] {
        let (key, value) =
            part.split_once('=').ok_or_else(|| wrong(format!("'{part}' is not of the form key=value")))?;
        if options.insert(key.to_owned(), value.to_owned()).is_some() {
            return Err(wrong(format!("'{key}' occurs twice")));
        }
    }
    Ok((id, options))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_id_and_arguments() -> Result<()> {
        assert_eq!(parse("CartPole-v1")?, ("CartPole-v1", BTreeMap::new()));
        let (id, options) = parse("my.envs:Maze-v0,size=(3,4),name='a,b',hard=true")?;
        assert_eq!(id, "my.envs:Maze-v0");
        let expected = [("hard", "true"), ("name", "'a,b'"), ("size", "(3,4)")];
        assert_eq!(options, expected.map(|(key, value)| (key.to_owned(), value.to_owned())).into());
        for (text, words) in
            [("", "no id"), ("CartPole-v1,fast", "'fast' is not of the form key=value"), ("A,k=1,k=2", "twice")]
        {
            let error = parse(text).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
        Ok(())
    }

    #[test]
    fn files_choose_registered_environments_only() -> Result<()> {
        let file = Origin::file("config.json", false);
        for text in [
            "CartPole-v1,render_mode=rgb_array",
            "ALE/Pong-v5,repeat_action_probability=0.25",
            "A-v0,size=(3, 4),map=4x4",
        ] {
            assert_eq!(TrustedId::new(text, &file)?.text(), text);
        }
        let texts = [
            "evil_mod:X-v0",
            "a.b:c:X-v0",
            "Ant-v5,xml_file=/tmp/a.xml",
            "A-v0,env_id=evil:B-v0",
            "A-v0,policy=evil.mod",
            "A-v0,x='a'",
            "A-v0,x={1: 2}",
            "CartPole-v1,render_mode=human",
        ];
        for text in texts {
            let error = TrustedId::new(text, &file).expect_err(text).to_string();
            for part in ["config.json", text, "--env", "--trust"] {
                assert!(error.contains(part), "{part}: {error}");
            }
            TrustedId::new(text, &Origin::User)?;
        }
        Ok(())
    }
}
