//! Golden files: rollouts that the Python reference recorded, as arrays in `.npz` archives.

use npyz::npz::NpzArchive;
use npyz::{DType, TypeChar};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use swm_core::VariationRequest;

/// Returns the golden files whose names start with `prefix`, sorted by name.
///
/// The files are in `tests/golden` in the crate's folder and in the folder that the environment variable `SWM_GOLDEN`
/// names (default: `shared/reference/golden` next to the workspace). Of two files with the same name, the file in the
/// folder of `SWM_GOLDEN` is used.
pub fn files(crate_folder: &str, prefix: &str) -> Vec<PathBuf> {
    let root = Path::new(crate_folder);
    let shared =
        std::env::var_os("SWM_GOLDEN").map_or_else(|| root.join("../../../shared/reference/golden"), PathBuf::from);
    let mut found = BTreeMap::new();
    for folder in [root.join("tests/golden"), shared] {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with(prefix) && name.ends_with(".npz") {
                found.insert(name, entry.path());
            }
        }
    }
    found.into_values().collect()
}

/// A golden file. The methods are for tests: they panic when an array is missing or has another type.
pub struct Golden(NpzArchive<BufReader<File>>);

impl Golden {
    /// Opens a file.
    pub fn open(path: &Path) -> Self {
        Self(NpzArchive::open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
    }

    /// Returns the names of the arrays.
    pub fn names(&self) -> Vec<String> {
        self.0.array_names().map(str::to_owned).collect()
    }

    /// Returns whether the file contains the array `name`.
    pub fn has(&self, name: &str) -> bool {
        self.names().iter().any(|known| known == name)
    }

    fn array<'a>(&'a mut self, name: &str) -> npyz::NpyFile<impl std::io::Read + 'a> {
        self.0.by_name(name).expect("reading the archive").unwrap_or_else(|| panic!("no array '{name}'"))
    }

    /// Returns all elements of an array of type `T`, in row-major order.
    pub fn read<T: npyz::Deserialize>(&mut self, name: &str) -> Vec<T> {
        self.array(name).into_vec().unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// All elements of a numeric array of any type, converted to `f64`, in row-major order.
    pub fn values(&mut self, name: &str) -> Vec<f64> {
        let kind = match self.array(name).dtype() {
            DType::Plain(kind) => (kind.type_char(), kind.size_field()),
            other => panic!("{name} has type {other:?}"),
        };
        match kind {
            (TypeChar::Float, 8) => self.read(name),
            (TypeChar::Float, 4) => self.read::<f32>(name).into_iter().map(f64::from).collect(),
            (TypeChar::Bool, _) => self.read::<bool>(name).into_iter().map(|b| f64::from(u8::from(b))).collect(),
            (TypeChar::Int, 4) => self.read::<i32>(name).into_iter().map(f64::from).collect(),
            (TypeChar::Int, 8) => self.read::<i64>(name).into_iter().map(|n| n as f64).collect(),
            other => panic!("{name} has type {other:?}"),
        }
    }

    /// Reads an RGB image and returns its height, its width and its bytes, `[height, width, 3]`.
    pub fn image(&mut self, name: &str) -> (usize, usize, Vec<u8>) {
        let array = self.array(name);
        let &[height, width, 3] = array.shape() else { panic!("{name} is not an RGB image") };
        let side = |n| usize::try_from(n).expect("an image size that fits usize");
        (side(height), side(width), array.into_vec().unwrap_or_else(|error| panic!("{name}: {error}")))
    }

    /// Reads a string.
    pub fn text(&mut self, name: &str) -> String {
        self.read::<String>(name).concat()
    }

    /// Returns a request that sets every factor of variation to its recorded value.
    pub fn variation(&mut self) -> VariationRequest {
        let mut request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let text = self.text("variation");
        flatten(
            "",
            &serde_json::from_str(&text).expect("parsing the factors of variation"),
            &mut request.variation_values,
        );
        request
    }
}

/// Flattens nested factors to keys with dots; the values of a factor are flattened in row-major order.
fn flatten(key: &str, value: &serde_json::Value, into: &mut BTreeMap<String, Vec<f64>>) {
    fn flatten_values(value: &serde_json::Value, into: &mut Vec<f64>) {
        match value {
            serde_json::Value::Array(values) => values.iter().for_each(|value| flatten_values(value, into)),
            value => into.push(value.as_f64().expect("a numeric factor value")),
        }
    }
    match value {
        serde_json::Value::Object(map) => {
            for (name, value) in map {
                let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                flatten(&key, value, into);
            }
        }
        value => flatten_values(value, into.entry(key.to_owned()).or_default()),
    }
}

/// The mean absolute difference of two images, in units of 1/255.
///
/// # Shapes
/// `a` and `b` have the same shape.
///
/// # Panics
/// When the lengths differ.
pub fn image_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64
}
