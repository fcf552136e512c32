//! Rollouts that the Python reference recorded, read from `SWM_GOLDEN` and from the folder beside this test. The tests of
//! `src/dmc/golden.rs` read them as well.

use npyz::npz::NpzArchive;
use npyz::{DType, TypeChar};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use swm_core::VariationRequest;

/// Golden files whose names begin so, by name; a file of the shared folder stands for its copy here.
pub fn files(prefix: &str) -> Vec<PathBuf> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let shared =
        std::env::var_os("SWM_GOLDEN").map_or_else(|| here.join("../../../shared/reference/golden"), PathBuf::from);
    let mut found = BTreeMap::new();
    for folder in [here.join("tests/golden"), shared] {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(prefix) && name.ends_with(".npz") {
                found.insert(name, entry.path());
            }
        }
    }
    found.into_values().collect()
}

/// One golden file.
pub struct Golden(NpzArchive<BufReader<File>>);

impl Golden {
    /// Opens a file.
    pub fn open(path: &Path) -> Self {
        Self(NpzArchive::open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
    }

    /// The names of its arrays.
    pub fn names(&self) -> Vec<String> {
        self.0.array_names().map(str::to_owned).collect()
    }

    /// Whether it has an array.
    pub fn has(&self, name: &str) -> bool {
        self.names().iter().any(|known| known == name)
    }

    fn array<'a>(&'a mut self, name: &str) -> npyz::NpyFile<impl std::io::Read + 'a> {
        self.0.by_name(name).expect("a readable archive").unwrap_or_else(|| panic!("no array '{name}'"))
    }

    /// All numbers of an array, row after row, whatever their type.
    pub fn numbers(&mut self, name: &str) -> Vec<f64> {
        let array = self.array(name);
        let kind = match array.dtype() {
            DType::Plain(kind) => (kind.type_char(), kind.size_field()),
            other => panic!("{name} holds {other:?}"),
        };
        let read: std::io::Result<Vec<f64>> = match kind {
            (TypeChar::Float, 8) => array.into_vec(),
            (TypeChar::Float, 4) => array.into_vec::<f32>().map(|all| all.into_iter().map(f64::from).collect()),
            (TypeChar::Bool, _) => {
                array.into_vec::<bool>().map(|all| all.into_iter().map(|b| f64::from(u8::from(b))).collect())
            }
            (TypeChar::Int, 4) => array.into_vec::<i32>().map(|all| all.into_iter().map(f64::from).collect()),
            (TypeChar::Int, 8) => array.into_vec::<i64>().map(|all| all.into_iter().map(|n| n as f64).collect()),
            other => panic!("{name} holds {other:?}"),
        };
        read.unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// A picture: height, width, and its RGB bytes.
    pub fn picture(&mut self, name: &str) -> (usize, usize, Vec<u8>) {
        let array = self.array(name);
        let &[height, width, 3] = array.shape() else { panic!("{name} is no RGB picture") };
        let side = |n| usize::try_from(n).expect("a size");
        (side(height), side(width), array.into_vec().unwrap_or_else(|error| panic!("{name}: {error}")))
    }

    /// A text.
    pub fn text(&mut self, name: &str) -> String {
        self.array(name).into_vec::<String>().unwrap_or_else(|error| panic!("{name}: {error}")).concat()
    }

    /// A request that pins every factor to what was recorded.
    pub fn variation(&mut self) -> VariationRequest {
        let mut request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let text = self.text("variation");
        flatten("", &serde_json::from_str(&text).expect("JSON"), &mut request.variation_values);
        request
    }
}

/// Nested factors by dot key, their numbers in a row.
fn flatten(key: &str, value: &serde_json::Value, into: &mut BTreeMap<String, Vec<f64>>) {
    fn numbers(value: &serde_json::Value, into: &mut Vec<f64>) {
        match value {
            serde_json::Value::Array(values) => values.iter().for_each(|value| numbers(value, into)),
            value => into.push(value.as_f64().expect("a number")),
        }
    }
    match value {
        serde_json::Value::Object(map) => {
            for (name, value) in map {
                let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                flatten(&key, value, into);
            }
        }
        value => numbers(value, into.entry(key.to_owned()).or_default()),
    }
}
