//! Printing: the only module that writes to standard output and standard error.
//!
//! Names that come from files are printed with [`printable`], so that they cannot control the terminal. A write to
//! standard output that fails is remembered; the command finishes its work and then exits with an error, because its
//! output is lost. A closed pipe is not an error: `swm envs | head` has all that it needs.

use comfy_table::{Attribute, Cell, Color, ColumnConstraint, Width};
use std::borrow::Cow;
use std::fmt::Write as _;
use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::io::{Error, ErrorKind, IsTerminal, Write};
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock, PoisonError};
use swm_core::text::printable;

/// The first failure of a write to standard output.
static FAILURE: Mutex<Option<Error>> = Mutex::new(None);

/// Prints to standard output.
pub fn emit(text: &str) {
    write_out(&with_escapes(&printable(text)));
}

/// What stands for the escape character of a terminal in the texts of [`table`], until they are printed. Names in other texts
/// cannot contain it: it has a number that is drawn when the program starts.
fn escape() -> &'static str {
    static ESCAPE: OnceLock<String> = OnceLock::new();
    ESCAPE.get_or_init(|| format!("<{:016x}>", RandomState::new().build_hasher().finish()))
}

/// Puts the escape characters of tables in their places.
fn with_escapes(text: &str) -> Cow<'_, str> {
    if text.contains(escape()) { Cow::Owned(text.replace(escape(), "\x1b")) } else { Cow::Borrowed(text) }
}

/// Paths as texts for [`emit_json`]. A single one is `path.to_string_lossy()`: JSON holds no path that is not UTF-8.
pub fn as_texts(paths: &[PathBuf]) -> Vec<Cow<'_, str>> {
    paths.iter().map(|path| path.to_string_lossy()).collect()
}

/// Prints one JSON document to standard output. JSON has its own escapes for control characters.
pub fn emit_json(value: &impl serde::Serialize) -> anyhow::Result<()> {
    write_out(&escaped_json(&serde_json::to_string_pretty(value)?));
    write_out("\n");
    Ok(())
}

/// Prints to standard error. There is no other stream to report a failure to.
pub fn eprint(text: &str) {
    std::io::stderr().write_all(printable(text).as_bytes()).ok();
}

/// Prints a text with its own colours to standard error.
pub fn print_styled(text: &str) {
    std::io::stderr().write_all(text.as_bytes()).ok();
}

/// Returns the beginning of a command line that is too long for a terminal.
pub fn shorten(command: String) -> String {
    const MOST: usize = 2000;
    match command.char_indices().nth(MOST) {
        Some((end, _)) => format!("{} ...", &command[..end]),
        None => command,
    }
}

/// Prints an error, a complete sentence, to standard error.
pub fn print_error(text: &str) {
    let label = if is_coloured(&std::io::stderr()) { "\x1b[1;31merror:\x1b[0m" } else { "error:" };
    std::io::stderr().write_all(format!("{label} {}\n", printable(text)).as_bytes()).ok();
}

/// Whether texts on a stream have colours: on a terminal, unless `NO_COLOR` is set (no-color.org) or the terminal has none.
pub fn is_coloured(stream: &impl IsTerminal) -> bool {
    let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    stream.is_terminal() && !is_set("NO_COLOR") && std::env::var_os("TERM").is_none_or(|name| name != "dumb")
}

/// Returns the failure of standard output, if its content is lost: none after a closed pipe.
pub fn take_failure() -> Option<Error> {
    let failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take();
    failure.filter(|error| error.kind() != ErrorKind::BrokenPipe)
}

/// Remembers the first failure of standard output.
pub fn check(written: std::io::Result<()>) {
    if let Err(error) = written {
        FAILURE.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

fn write_out(text: &str) {
    let mut out = std::io::stdout().lock();
    check(out.write_all(text.as_bytes()).and_then(|()| out.flush()));
}

/// Escapes the characters that [`printable`] escapes as JSON does. They occur within strings only, as serde_json writes
/// no others between values.
fn escaped_json(json: &str) -> Cow<'_, str> {
    if matches!(printable(json), Cow::Borrowed(_)) {
        return Cow::Borrowed(json);
    }
    let mut escaped = String::with_capacity(json.len());
    for c in json.chars() {
        match printable(c.encode_utf8(&mut [0; 4])) {
            Cow::Borrowed(same) => escaped.push_str(same),
            Cow::Owned(_) => {
                let _ = write!(escaped, "\\u{:04x}", u32::from(c));
            }
        }
    }
    Cow::Owned(escaped)
}

/// The most characters of a word that keep a column of a table wide; longer words are broken.
const LONGEST_WORD: usize = 24;
/// The width that every column gets before words of other columns are kept whole.
const NARROW: usize = 10;
/// The most characters of a line of a cell, and the most lines of a cell.
const MAX_CELL: usize = 400;
const MAX_LINES: usize = 100;

/// Returns the width of the longest word of each column.
fn longest_words(header: &[&str], rows: &[Vec<String>]) -> Vec<usize> {
    let longest = |text: &str| text.split_whitespace().map(|word| word.chars().count()).max().unwrap_or(0);
    let column = |(index, name): (usize, &&str)| {
        let cells = rows.iter().filter_map(|row| row.get(index)).map(|cell| longest(&printable(cell)));
        cells.chain([longest(name)]).max().unwrap_or(0)
    };
    header.iter().enumerate().map(column).collect()
}

/// Keeps the words of columns whole, from the first column on, as far as the terminal is wide enough.
fn keep_words(table: &mut comfy_table::Table, words: &[usize]) {
    let Some(mut free) = table.width().map(usize::from) else { return };
    // A space on both sides of a cell.
    let widths: Vec<usize> = words.iter().map(|width| width.min(&LONGEST_WORD) + 2).collect();
    for (index, column) in table.column_iter_mut().enumerate() {
        let rest: usize = widths[index + 1..].iter().map(|width| width.min(&NARROW)).sum();
        if widths[index] + rest <= free {
            column.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(widths[index] as u16)));
        }
        free = free.saturating_sub(widths[index].min(free.saturating_sub(rest)));
    }
}

/// Formats rows as a table with a header.
pub fn table(header: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let rows: Vec<Vec<String>> = rows.into_iter().map(|row| row.into_iter().map(shortened).collect()).collect();
    let mut table = comfy_table::Table::new();
    table.load_preset(comfy_table::presets::NOTHING);
    table.set_style(comfy_table::TableComponent::HeaderLines, '─');
    table.set_style(comfy_table::TableComponent::MiddleHeaderIntersections, '─');
    table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    let coloured = is_coloured(&std::io::stdout());
    let bold = |cell: Cell| if coloured { cell.add_attribute(Attribute::Bold) } else { cell };
    table.set_header(header.iter().map(|name| bold(Cell::new(printable(name)))));
    for row in &rows {
        // Escaped here and not in the finished table, so that columns have the widths of the escaped cells.
        table.add_row(row.iter().map(|cell| {
            let shown = Cell::new(printable(cell));
            match emphasis(cell).filter(|_| coloured) {
                Some(Emphasis::Colour(colour)) => shown.fg(colour),
                Some(Emphasis::Dim) => shown.add_attribute(Attribute::Dim),
                None => shown,
            }
        }));
    }
    keep_words(&mut table, &longest_words(header, &rows));
    // All cells are escaped, so that every escape character is one of the table.
    format!("{table}\n").replace('\x1b', escape())
}

/// Returns a cell of at most [`MAX_LINES`] lines of [`MAX_CELL`] characters: every line of a table is as wide as its longest cell
/// in a pipe.
fn shortened(cell: String) -> String {
    let shown = |line: &str| match line.char_indices().nth(MAX_CELL) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line.to_owned(),
    };
    let mut lines = cell.split('\n');
    let mut all: Vec<String> = lines.by_ref().take(MAX_LINES).map(shown).collect();
    all.extend(lines.next().map(|_| "…".to_owned()));
    all.join("\n")
}

/// How a cell stands out.
#[derive(Debug, PartialEq)]
enum Emphasis {
    Colour(Color),
    Dim,
}

/// How a cell stands out: verdicts by what they say, and missing values.
fn emphasis(cell: &str) -> Option<Emphasis> {
    match cell {
        "higher" => Some(Emphasis::Colour(Color::Green)),
        "lower" => Some(Emphasis::Colour(Color::Red)),
        "not told apart" | "too few" | "–" => Some(Emphasis::Dim),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn narrow_tables_break_lines_between_words() {
        let (header, row) =
            (["solver", "method"], ["predictive_sampling", "tries many guesses once"].map(str::to_owned));
        let mut table = comfy_table::Table::new();
        table.load_preset(comfy_table::presets::NOTHING).set_header(header);
        table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic).set_width(32).add_row(&row);
        keep_words(&mut table, &longest_words(&header, &[row.to_vec()]));
        let shown = table.to_string();
        assert!(shown.contains("predictive_sampling") && shown.lines().all(|line| line.len() <= 32), "{shown}");
        // Too narrow for all words.
        table.set_width(20);
        keep_words(&mut table, &longest_words(&header, &[row.to_vec()]));
        assert!(table.to_string().lines().all(|line| line.len() <= 32), "{table}");
    }

    #[test]
    fn long_cells_of_tables_are_cut() {
        let shown = table(&["column", "values"], [vec!["é".repeat(100_000), "1".to_owned()]]);
        assert!(shown.contains('…') && shown.chars().count() < 10 * MAX_CELL, "{} characters", shown.chars().count());
        assert_eq!(shortened("é".repeat(MAX_CELL)), "é".repeat(MAX_CELL));
        // The settings of a solver are a line each.
        let lines = vec!["state_optimizer.epsilon=0.00000001"; 30].join("\n");
        assert_eq!(shortened(lines.clone()), lines);
        let cut = shortened("a\n".repeat(100_000));
        assert!(cut.ends_with("\n…") && cut.lines().count() == MAX_LINES + 1, "{} lines", cut.lines().count());
    }

    #[test]
    fn tables_of_pipes_have_no_colours() {
        assert_eq!(emphasis("lower"), Some(Emphasis::Colour(Color::Red)));
        assert_eq!((emphasis("–"), emphasis("lower than")), (Some(Emphasis::Dim), None));
        assert_eq!(with_escapes(&printable(&format!("a{}[1mb", escape()))), "a\x1b[1mb");
        assert!(!with_escapes(&printable("a\x1b[1mb")).contains('\x1b'));
        let file = std::fs::File::open("/dev/null").expect("a file");
        assert!(!is_coloured(&file));
    }

    #[test]
    fn json_with_control_characters_stays_the_same_document() {
        let value = serde_json::json!({"name\u{9b}": ["a\u{7f}\u{202e}b", "\u{1b}[31m", "größe"]});
        let text = serde_json::to_string_pretty(&value).expect("a document");
        let escaped = escaped_json(&text);
        assert!(escaped.contains("name\\u009b") && escaped.contains("a\\u007f\\u202eb"), "{escaped}");
        assert!(escaped.contains("größe"));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&escaped).expect("a document"), value);
    }
}
