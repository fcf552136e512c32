//! Rollouts that the Python reference recorded, read from `SWM_GOLDEN` and from the folder beside this test.

use npyz::npz::NpzArchive;
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

    /// All numbers of an array, row after row.
    pub fn read<T: npyz::Deserialize>(&mut self, name: &str) -> Vec<T> {
        let array = self.0.by_name(name).expect("a readable archive").unwrap_or_else(|| panic!("no array '{name}'"));
        array.into_vec().unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// A picture: height, width, and its RGB bytes.
    pub fn picture(&mut self, name: &str) -> (usize, usize, Vec<u8>) {
        let array = self.0.by_name(name).expect("a readable archive").unwrap_or_else(|| panic!("no array '{name}'"));
        let &[height, width, 3] = array.shape() else { panic!("{name} is no RGB picture") };
        let side = |n| usize::try_from(n).expect("a size");
        (side(height), side(width), array.into_vec().unwrap_or_else(|error| panic!("{name}: {error}")))
    }

    /// A request that pins every factor to what was recorded.
    pub fn variation(&mut self) -> VariationRequest {
        let text = self.read::<String>("variation").concat();
        let mut request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        flatten("", &serde_json::from_str(&text).expect("JSON"), &mut request.variation_values);
        request
    }
}

fn flatten(key: &str, value: &serde_json::Value, into: &mut BTreeMap<String, Vec<f64>>) {
    let number = |v: &serde_json::Value| v.as_f64().expect("a number");
    match value {
        serde_json::Value::Object(map) => {
            for (name, value) in map {
                let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                flatten(&key, value, into);
            }
        }
        serde_json::Value::Array(values) => {
            let rows =
                values.iter().flat_map(|value| value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice));
            into.insert(key.to_owned(), rows.map(number).collect());
        }
        value => {
            into.insert(key.to_owned(), vec![number(value)]);
        }
    }
}

/// The mean absolute difference of two pictures, of 255.
pub fn picture_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64
}
