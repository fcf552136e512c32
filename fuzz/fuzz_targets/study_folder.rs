//! The folder of a study: its cells, their results, its registration and image distances, and its page.

#![no_main]

use std::collections::BTreeMap;
use std::sync::LazyLock;
use swm::cli::Pages;
use swm::cli::study::{export, write_page};
use swm::lab::reports::{Kind, Reports as _};
use swm_core::files;
use swm_core::results::{Published, TableColumn};
use swm_core::run::Control;
use swm_eval::{Cell, Common, Measured, Study, StudyFolder, TableCell, TableStudy};
use swm_fuzz::Originals;

/// Of so many inputs, one has its page written.
const PAGES: usize = 16;

/// A study of two conditions and a study of a table.
static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    let mut originals = Originals::default();
    let (mut results, mut cells) = (swm_fuzz::entry().results, vec![]);
    for (name, colour) in [("plain", 0), ("blue", 255)] {
        let config = &mut results.manifest.config;
        config["conditions"][0]["name"] = name.into();
        config["conditions"][0]["variation"]["variation_values"]["agent.color"] = vec![0, 0, colour].into();
        results.runs.iter_mut().for_each(|run| run.condition = name.to_owned());
        results.comparisons.clear();
        let mut request = swm_eval::EvalRequest::of(&results.manifest).expect("a request");
        // The policy of a cell is its first one.
        request.policies.reverse();
        let variables = BTreeMap::from([("blue".to_owned(), colour.to_string())]);
        let (starts, inputs) = ("drawn".to_owned(), BTreeMap::new());
        let cell =
            Cell { starts, variables, any_seed: None, trained_on_starts: None, request, inputs, sequential: false };
        cells.push((cell, results.clone()));
    }
    let rate =
        Published { starts: None, condition: "blue".into(), policy: "lewm".into(), rate: 0.5, source: "p".into() };
    let study = Study {
        title: "t".into(),
        question: "q?".into(),
        families: Common::by_default(),
        cells: cells.iter().map(|(cell, _)| cell.clone()).collect(),
        until: None,
        ray: None,
        published: vec![rate],
        arguments: vec!["study.toml".into(), "episodes=3".into()],
    };
    let path = swm_fuzz::scratch().join("study");
    let folder = StudyFolder::new(&path);
    folder.register(&study, "2026-11-24T01:02:03Z").expect("a registration");
    for (cell, results) in cells {
        folder.store(&cell, results).expect("results");
        let distance = format!("{{\"{}\": {{\"mean\": 3.5, \"starts\": 3}}}}", cell.id().expect("an id"));
        files::write(&path.join("image-distances.json"), distance.as_bytes()).expect("a file in memory");
    }
    originals.add(&path);

    let column = |published| TableColumn { name: "c".into(), unit: "u".into(), published };
    let cell = |of: &str| TableCell { name: of.into(), request: of.into(), published: vec![Some(2.0)] };
    let study = TableStudy {
        kind: "drift".into(),
        title: "t".into(),
        question: "q?".into(),
        subject: "word".into(),
        columns: vec![column(false), column(true)],
        source: "p".into(),
        cells: vec![cell("a"), cell("b")],
        arguments: vec![],
    };
    let path = swm_fuzz::scratch().join("table");
    let folder = StudyFolder::new(&path);
    folder.create_table(&study).expect("a folder");
    let measured = Measured { values: vec![1.5], paths: vec![vec![[0.0, 1.0], [2.0, 3.0]], vec![[1.0, 1.0]]] };
    let measure = &mut |_: &TableCell, _: &mut Control<'_>| Ok(Some(measured.clone()));
    study.run(&folder, "x86_64", measure, &mut Control::new()).expect("rows");
    originals.add(&path);
    originals
});

libfuzzer_sys::fuzz_target!(
    init: {
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| ORIGINALS.with(bytes, |path| {
        let _ = Pages.summary(Kind::Study, path);
        for format in ["csv", "csv-seeds", "latex", "markdown"] {
            let _ = export(path, format);
        }
        // The page takes seconds, because its figures are drawn as PNG files, too.
        if bytes.iter().map(|byte| usize::from(*byte)).sum::<usize>() % PAGES == 0
            && let Ok((_, page)) = write_page(&StudyFolder::new(path), None, &swm_fuzz::scratch().join("page"))
        {
            assert!(files::read(&page, 5_000_000).is_ok());
        }
    })
);
