//! Tests of the page of a study, from synthetic and from hostile results.

use super::well_formed;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use swm_core::results::{
    BreakingPoint, ClusteredMean, Counting, Crossing, ErrorAndSuccess, Family, Interquartile, Level, OverSeeds, Paired,
    PlayedErrors, Prediction, Proportion, Published, Ray, Side, StudyResults, StudyRow, StudyTable, TableColumn,
    TableRow, Trajectory,
};
use swm_report::{StudyPage, TablePage, write_study};

/// A row of a study: `successes` of 50 episodes, of which the first condition solves 40.
fn row(condition: &str, policy: &str, variables: &[(&str, &str)], successes: usize) -> StudyRow {
    let both = successes.min(40);
    StudyRow {
        cell: "00".to_owned(),
        starts: "held-out episodes".to_owned(),
        condition: condition.to_owned(),
        variables: variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect(),
        policy: policy.to_owned(),
        any_seed: None,
        counting: Counting::default(),
        seed: 0,
        success: Proportion::wilson(successes, 50),
        solved_at_start: 0,
        floor: Proportion::wilson(2, 50),
        gap: (condition != "in distribution").then(|| Paired::of(both, successes - both, 40 - both, 10)),
        trained_on_starts: None,
        image_distance: None,
        prediction: None,
        played: None,
        by_displacement: vec![],
    }
}

fn of(rows: Vec<StudyRow>) -> StudyPage {
    let results = StudyResults {
        title: "Colours & shapes".to_owned(),
        question: "Which colours does the model tolerate?".to_owned(),
        hash: "3f".repeat(32),
        cells: rows.len() + 1,
        done: rows.len(),
        rows,
        ..StudyResults::default()
    };
    StudyPage {
        results,
        command: Some("swm study run paper/factors --output factors".to_owned()),
        ..StudyPage::default()
    }
}

/// Two policies under five conditions with both countings.
fn factors() -> StudyPage {
    let mut rows = vec![];
    for counting in [Counting::default(), Counting::Compat { envs: 8 }] {
        let rates =
            [("in distribution", 40, 40), ("agent.color", 6, 12), ("agent.shape", 41, 20), ("block.scale", 20, 31)];
        for (condition, first, second) in rates {
            for (policy, successes) in [("LeWM", first), ("PLDM", second)] {
                rows.push(StudyRow { counting, ..row(condition, policy, &[("factor", condition)], successes) });
            }
        }
    }
    let published = |policy: &str, rate| Published {
        starts: None,
        condition: "agent.color".to_owned(),
        policy: policy.to_owned(),
        rate,
        source: "table of factors".to_owned(),
    };
    StudyPage { published: vec![published("DINO-WM", 0.18), published("PLDM", 0.08)], ..of(rows) }
}

/// A line of success against a number, with long names.
fn line() -> StudyPage {
    let values = ["1", "2", "4", "8", "16"];
    let long = "checkpoints/a-policy-whose-name-has-no-spaces-and-is-much-longer-than-any-column-of-a-table";
    let each = |policy: &'static str| {
        let row = move |(i, x): (usize, &&str)| row(&format!("{x} squares"), policy, &[("count", x)], 38 - 7 * i);
        let plain = self::row("in distribution", policy, &[("count", "0")], 40);
        std::iter::once(plain).chain(values.iter().enumerate().map(row)).collect::<Vec<_>>()
    };
    of([each("LeWM"), each(long)].concat())
}

/// A wheel of hues.
fn wheel() -> StudyPage {
    let mut rows = vec![row("in distribution", "LeWM", &[], 40)];
    for saturation in ["0.5", "1"] {
        for hue in ["0", "60", "120", "180", "240", "300"] {
            let name = format!("hue {hue}, saturation {saturation}");
            rows.push(row(&name, "LeWM", &[("hue", hue), ("saturation", saturation)], hue.len() * 10));
        }
    }
    of(rows)
}

/// A map of many conditions.
fn heat() -> StudyPage {
    let mut rows = vec![row("in distribution", "LeWM", &[], 40)];
    rows.extend((0..130).map(|i| row(&format!("condition {i}"), "LeWM", &[], i % 40)));
    of(rows)
}

/// Prediction errors of solved and of failed trajectories, recorded and played.
fn predictions() -> StudyPage {
    let mut study = factors();
    let trajectory = |i: usize| Trajectory {
        start: [i, 3],
        success: Some(!i.is_multiple_of(3)),
        errors: vec![0.2 + 0.013 * ((i * 37) % 50) as f64; 5],
    };
    let errors = ErrorAndSuccess::of(&Prediction::new(5, 1.0, (0..50).map(trajectory).collect()));
    for row in &mut study.results.rows {
        row.prediction = Some(errors.clone());
        let optimism = Some(ClusteredMean { mean: 0.1234, low: -0.5678, high: 0.9012 });
        row.played = Some(PlayedErrors { errors: errors.clone(), optimism });
    }
    study
}

/// Pages with every kind of figure and table.
pub(super) fn pages() -> Vec<StudyPage> {
    let mut study = factors();
    study.results.over_seeds = vec![over_seeds("LeWM, seed *", 0.5)];
    vec![study, line(), wheel(), heat(), predictions()]
}

/// A page of a study whose cells are no evaluations, with many columns.
pub(super) fn table() -> TablePage {
    let column = |i: usize| TableColumn {
        name: format!("{} of clips, cached", ["latency", "throughput", "size"][i % 3]),
        unit: ["ms", "clips/s", "MB"][i % 3].to_owned(),
        published: i > 5,
    };
    let row = |i: usize| TableRow {
        cell: String::new(),
        name: ["lance", "hdf5", "a format with a very long name", "lerobot"][i].to_owned(),
        values: (0..9).map(|j| (j % 4 != i).then_some(1234.5678 / (i + j + 1) as f64)).collect(),
        machine: "a processor with two cores".to_owned(),
        paths: vec![],
    };
    let results = StudyTable {
        title: "Formats".to_owned(),
        columns: (0..9).map(column).collect(),
        rows: (0..4).map(row).collect(),
        cells: 4,
        done: 4,
        ..StudyTable::default()
    };
    TablePage { results, ..TablePage::default() }
}

/// All files that a page consists of.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    for folder in [folder.to_owned(), folder.join("figures")] {
        for entry in fs::read_dir(&folder).expect("reading a folder").flatten().filter(|entry| entry.path().is_file()) {
            let bytes = fs::read(entry.path()).expect("reading a file");
            found.insert(entry.file_name().to_string_lossy().into_owned(), bytes);
        }
    }
    found
}

/// Writes a page, checks what holds for every page, and returns its text.
fn page(study: &StudyPage, folder: &Path) -> String {
    let path = write_study(study, folder).expect("writing the page");
    let page = fs::read_to_string(path).expect("reading the page");
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    well_formed(&page.replace("&apos;", "&#39;"));
    assert!(!page.contains("<script") && !page.contains("src=\"http") && !page.contains("@import"));
    assert!(!page.contains("NaN") && !page.contains("inf\""));
    for (name, bytes) in files(folder) {
        match name.rsplit('.').next() {
            Some("svg") => {
                let svg = String::from_utf8(bytes).expect("UTF-8").replace("&apos;", "&#39;");
                well_formed(&format!("<!DOCTYPE html>{svg}"));
            }
            Some("png") => assert!(bytes.starts_with(b"\x89PNG"), "{name}"),
            _ => {}
        }
    }
    page.replace('\u{a0}', " ")
}

#[test]
fn page_of_a_study_has_its_answer_table_figures_and_published_values() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&factors(), folder.path());
    // 6 of 50: Wilson 5.6 to 23.8 %. 34 of the 40 solved starts are lost under agent.color: 68 points.
    for words in [
        "<h1>Colours &amp; shapes</h1>",
        "Which colours does the model tolerate?",
        "With 16 of 17 cells done, success falls most for LeWM under “agent.color”, by 68.0 points [",
        "with strict counting; 5 of 6 gaps are told apart from zero (LeWM 2 of 3, PLDM 3 of 3).",
        &"3f".repeat(32),
        "<pre>swm study run paper/factors --output factors</pre>",
        "<b>12.0 %</b> [6, 24]",
        "<b>\u{2212}68.0 [",
        "Success, strict",
        "Gap, compat",
        "Gap of each condition · strict counting",
        "<summary>Gap of each condition · compat counting</summary>",
        "<code>figures/drop-2.png</code>",
        "data-label=\"Published\">8.0 % [1]</td><td class=\"n\" data-label=\"Ours, strict\"><b>24.0 %</b> [14, 37]</td>\
         <td class=\"n\" data-label=\"Difference, strict\">+16.0</td>",
        "not run",
        "<li>table of factors</li>",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
    assert!(page.find("8.0 % [1]") < page.find("18.0 % [1]"), "published values are in the order of the study");
    let names: Vec<String> = files(folder.path()).into_keys().collect();
    assert_eq!(names, ["drop-1.png", "drop-1.svg", "drop-2.png", "drop-2.svg", "index.html"]);
}

/// Success over the training seeds of a policy.
fn over_seeds(policy: &str, rate: f64) -> OverSeeds {
    OverSeeds {
        starts: String::new(),
        condition: None,
        policy: policy.to_owned(),
        counting: Counting::default(),
        seed: 0,
        scores: (0..30).map(|seed| (seed.to_string(), rate)).collect(),
        mean: rate,
        new_seed: [0.125, rate],
        interquartile: Some(Interquartile { mean: rate, low: 0.25, high: rate }),
    }
}

#[test]
fn families_and_training_seeds_are_stated() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut study = factors();
    study.results.over_seeds = vec![over_seeds("LeWM, seed *", 0.5)];
    let mut tables = [Paired::of(20, 5, 15, 10), Paired::of(20, 1, 0, 10)];
    let mut tables: Vec<&mut Paired> = tables.iter_mut().collect();
    study.results.families = Family::correct("LeWM <1>", &mut tables, 0).into_iter().collect();
    let page = page(&study, folder.path());
    for words in [
        "LeWM &lt;1&gt;: 2 comparisons of 31 pairs tell a difference of ",
        "all shifted conditions",
        "LeWM, seed *",
        "0: 50.0, 1: 50.0, ",
        "19: 50.0, …</td>",
        "[12.5, 50.0]",
        "50.0 [25.0, 50.0]",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
}

#[test]
fn equal_studies_give_equal_bytes() {
    let [a, b] = [(); 2].map(|()| tempfile::tempdir().expect("creating a temporary folder"));
    for folder in [&a, &b] {
        write_study(&factors(), folder.path()).expect("writing the page");
    }
    assert!(files(a.path()) == files(b.path()));
    // Written over itself.
    write_study(&factors(), a.path()).expect("writing the page again");
    assert!(files(a.path()) == files(b.path()));
}

#[test]
fn colours_of_drawings_follow_the_theme() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&factors(), folder.path());
    let style = page.split("</style>").next().expect("a style sheet");
    let drawn = page.split("<svg").nth(1).and_then(|rest| rest.split("</svg>").next()).expect("a drawing");
    let mut colours = 0;
    for (start, attribute) in ["fill=\"#", "stroke=\"#"].iter().flat_map(|name| drawn.match_indices(name)) {
        let value = &drawn[start..start + attribute.len() + 7];
        assert!(style.contains(&format!(".chart [{value}]")), "{value}");
        colours += 1;
    }
    assert!(colours > 40, "{colours} colours");
}

#[test]
fn curves_wheels_and_maps_follow_from_the_conditions() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let values = ["1", "2", "4", "8", "16"];
    let successes = [38, 33, 25, 16, 6];
    let mut rows = vec![row("in distribution", "LeWM", &[("count", "0")], 40)];
    rows.extend(values.iter().zip(successes).map(|(x, k)| row(&format!("{x} squares"), "LeWM", &[("count", x)], k)));
    let mut study = of(rows);
    let line = page(&study, folder.path());
    assert!(line.contains("Success against count") && line.contains("LeWM: b = 0.1"), "{line}");
    // The interval of the decay is that of a fixed number of episodes.
    study.results.until = Some("ci=5".parse().expect("a rule"));
    let line = page(&study, folder.path());
    assert!(line.contains("ran until ci=5") && line.contains("Success against count") && !line.contains("LeWM: b ="));

    let mut rows = vec![row("in distribution", "LeWM", &[], 40)];
    for saturation in ["0.5", "1"] {
        for hue in ["0", "120", "240"] {
            let name = format!("hue {hue}, saturation {saturation}");
            rows.push(row(&name, "LeWM", &[("hue", hue), ("saturation", saturation)], hue.len() * 10));
        }
    }
    let wheel = page(&of(rows), folder.path());
    assert!(wheel.contains("Success over hue and saturation") && wheel.contains("#FF0000"));

    let mut rows = vec![row("in distribution", "LeWM", &[], 40)];
    rows.extend((0..130).map(|i| row(&format!("condition {i}"), "LeWM", &[], i % 40)));
    let heat = page(&of(rows), folder.path());
    assert!(heat.contains("Success of every policy") && heat.contains("The first 60 of 131 conditions are drawn"));
    let names: Vec<String> = files(folder.path()).into_keys().filter(|name| name.ends_with("svg")).collect();
    assert_eq!(names, ["heat-1.svg", "line-1.svg", "wheel-1.svg"]);
}

#[test]
fn page_of_ten_thousand_cells_is_small() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let cells = |n: usize, seeds: u64| {
        let policies = ["LeWM", "PLDM", "DINO-WM", "random"];
        let cell = |i: usize| {
            let condition = if i < policies.len() {
                "in distribution".to_owned()
            } else {
                format!("condition {} of the grid", i / 4)
            };
            StudyRow { seed: i as u64 % seeds, ..row(&condition, policies[i % 4], &[], i % 41) }
        };
        of((0..n).map(cell).collect())
    };
    let grid = page(&cells(10_000, 1), folder.path());
    assert!(grid.contains("condition 2000 of the grid"), "the table has most rows");
    // Every cell in a sheet of its own: figures and tables are bounded.
    let sheets = page(&cells(10_000, 10_000), folder.path());
    assert!(sheets.contains("more rows are in <code>table.csv</code>"), "{} bytes", sheets.len());
}

/// A family whose counts are as large as they can be.
fn family(name: &str, sequential: bool) -> Family {
    Family {
        name: name.to_owned(),
        comparisons: usize::MAX,
        pairs: usize::MAX,
        discordant: f64::NAN,
        detectable: None,
        sequential,
    }
}

/// A breaking point of a policy with many levels and crossings at one value.
fn breaking(policy: &str, condition: &str, value: f64, ordered: bool) -> BreakingPoint {
    let name = condition.to_owned();
    let (half, bound) = (Side::Above, Side::Below);
    let level = Level { condition: name.clone(), change: value, rate: value, half, bound };
    let crossing = Crossing { above: Some(name.clone()), below: None, estimates: vec![[value; 2]; 3000] };
    BreakingPoint {
        ray: Ray { factor: name.clone(), below: value, ordered },
        policy: policy.to_owned(),
        unshifted: value,
        levels: vec![level; 100],
        half: crossing.clone(),
        bound: crossing,
        rises: vec![[name.clone(), name]; 50],
    }
}

#[test]
fn hostile_names_and_values_are_escaped_and_bounded() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let long = "x".repeat(100_000);
    let names = [
        "<script>alert(1)</script>",
        "</svg><style>*{display:none}</style>",
        "\u{202e}\u{2066}gnp.exe",
        "a\u{0}b\u{1b}[31m\u{7f}",
        "\" onload=\"alert(1)",
        "]]>&amp;'",
        long.as_str(),
        "",
    ];
    let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1e308, 1e308, 5e-324];
    let mut rows = vec![];
    for (i, name) in names.iter().enumerate() {
        for (j, policy) in names.iter().enumerate() {
            let variables = [(names[(i + 2) % 8], names[(i + j) % 8]), ("hue", ["0", "nan", "1e308", "-90"][i % 4])];
            let mut row = row(name, policy, &variables, i * 5);
            let value = bad[(i + j) % bad.len()];
            match i % 4 {
                0 => (row.success.rate, row.success.low) = (value, value),
                1 => row.gap = row.gap.map(|gap| Paired { difference: value, ..gap }),
                2 => row.gap = row.gap.map(|gap| Paired { low: value, high: -value, ..gap }),
                _ => (row.floor.rate, row.success.successes, row.success.n) = (value, usize::MAX, usize::MAX),
            }
            row.starts = names[j].to_owned();
            rows.push(row.clone());
            rows.push(StudyRow { starts: String::new(), ..row });
        }
    }
    let mut study = of(rows);
    let of_names = |i: usize| Published {
        starts: None,
        condition: names[i % 8].to_owned(),
        policy: names[(i + 3) % 8].to_owned(),
        rate: bad[i % bad.len()],
        source: names[(i + 1) % 8].to_owned(),
    };
    study.published = (0..5000).map(of_names).collect();
    study.results.over_seeds = (0..5000).map(|i| over_seeds(names[i % 8], bad[i % bad.len()])).collect();
    let family = |i: usize| family(names[i % 8], i.is_multiple_of(2));
    study.results.families = (0..5000).map(family).collect();
    let point = |i: usize| breaking(names[i % 8], names[(i + 1) % 8], bad[i % bad.len()], i.is_multiple_of(2));
    study.results.breaking = (0..100).map(point).collect();
    for (title, text) in [(names[0], long.as_str()), (long.as_str(), names[1]), (names[2], names[3])] {
        study.results.title = title.to_owned();
        study.results.question = text.to_owned();
        study.results.hash = text.to_owned();
        study.command = Some(title.to_owned());
        let page = page(&study, folder.path());
        assert!(!page.contains(&"x".repeat(3000)) && !page.contains("<style>*") && !page.contains("onload=\"a"));
        assert!(
            !page.chars().any(|c| c == '\u{202e}' || c == '\u{2066}' || (c.is_control() && c != '\n' && c != '\t'))
        );
    }
}

#[test]
fn numbers_of_variables_may_have_any_size() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for values in [
        ["0", "5e-324", "1e-300"],
        ["1e308", "-1e308", "0"],
        ["1e15", "1000000000000001", "-0"],
        ["1", "1.0000000000000002", "1.0000000000000004"],
    ] {
        for name in ["x", "hue"] {
            let mut rows = vec![row("in distribution", "LeWM", &[], 40)];
            rows.extend(values.iter().map(|x| row(x, "LeWM", &[(name, x)], 20)));
            assert!(page(&of(rows), folder.path()).contains("<svg"), "{name} {values:?}");
        }
    }
}

#[test]
fn figures_are_not_written_through_a_link() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let outside = folder.path().join("outside");
    fs::create_dir_all(&outside).expect("creating a folder");
    fs::create_dir_all(folder.path().join("page")).expect("creating a folder");
    std::os::unix::fs::symlink(&outside, folder.path().join("page/figures")).expect("making a link");
    let error = write_study(&factors(), &folder.path().join("page")).expect_err("a link").to_string();
    assert!(error.contains("symbolic link"), "{error}");
    assert_eq!(fs::read_dir(&outside).expect("reading a folder").count(), 0);
}

#[test]
fn temporary_files_of_a_killed_report_are_deleted() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let figures = folder.path().join("figures");
    fs::create_dir(&figures).expect("creating a folder");
    let names = ["drop-1.svg", "drop-2.png", "thesis.svg", "-+3.png"];
    let names = names.map(|name| figures.join(format!(".{name}.12.tmp")));
    names.iter().for_each(|name| fs::write(name, "").expect("writing a file"));
    write_study(&factors(), folder.path()).expect("writing the page");
    assert_eq!(names.map(|name| name.exists()), [false, false, true, true]);
}

#[test]
fn study_without_results_has_a_page() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&of(vec![]), folder.path());
    assert!(page.contains("None of the 1 cells is done.") && !page.contains("<svg class=\"chart"));
}
