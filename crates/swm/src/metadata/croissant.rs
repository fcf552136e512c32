//! [`croissant`]: Croissant metadata, version 1.0 (<https://docs.mlcommons.org/croissant/docs/croissant-spec.html>).

use super::{Described, DescribedFile, Stated};
use serde_json::{Value, json};

/// Stands for the address of what is not published: the specification requires one.
const NO_URL: &str = "https://example.invalid/not-published";

/// Returns the description as Croissant metadata. Its files are those of the folder in which the document lies.
///
/// Columns and what was measured are `variableMeasured`. There are no record sets: Croissant requires a rule that extracts each
/// field, and has rules for CSV, JSON and Parquet only.
pub fn croissant(described: &Described) -> Value {
    let Described { name, summary, stated, files, content, columns, size, manifest, measured } = described;
    let Stated { licence, author, url } = stated;
    let mut document = json!({
        "@context": context(),
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": name,
        "description": summary,
        "version": "1.0.0",
        "isLiveDataset": false,
        "url": url.as_deref().unwrap_or(NO_URL),
        "distribution": files.iter().map(file).collect::<Vec<_>>(),
        "identifier": format!("blake3:{content}"),
    });
    if let Some(licence) = licence {
        document["license"] = json!(licence);
    }
    if let Some(author) = author {
        document["creator"] = json!({"@type": "sc:Organization", "name": author});
    }
    if let Some(manifest) = manifest {
        document["rai:dataCollection"] = json!(format!(
            "Made by `{}` of stable-worldmodel {} with the seed {}: {}",
            manifest.kind, manifest.swm_version, manifest.seed, manifest.config
        ));
    }
    let property = |name: &str, value: String| json!({"@type": "sc:PropertyValue", "name": name, "value": value});
    let columns =
        columns.iter().map(|column| property(&column.name, format!("{} {:?}", column.dtype.name(), column.shape)));
    let measured = measured.iter().map(|(name, value)| property(name, value.clone()));
    let size = size.map(|[episodes, rows]| property("size", format!("{episodes} episodes, {rows} rows")));
    let properties: Vec<Value> = size.into_iter().chain(columns).chain(measured).collect();
    if !properties.is_empty() {
        document["variableMeasured"] = json!(properties);
    }
    document
}

fn file(DescribedFile { path, bytes, sha256 }: &DescribedFile) -> Value {
    let kind = match path.rsplit('.').next() {
        Some("json" | "jsonl") => "application/json",
        Some("parquet") => "application/vnd.apache.parquet",
        Some("h5" | "hdf5") => "application/x-hdf5",
        Some("mp4") => "video/mp4",
        Some("png") => "image/png",
        Some("jpg" | "jpeg") => "image/jpeg",
        _ => "application/octet-stream",
    };
    json!({
        "@type": "cr:FileObject",
        "@id": path,
        "name": path,
        "contentUrl": path,
        "contentSize": format!("{bytes} B"),
        "encodingFormat": kind,
        "sha256": sha256,
    })
}

/// The context that the specification gives.
fn context() -> Value {
    let terms = [
        "citeAs",
        "column",
        "equivalentProperty",
        "extract",
        "field",
        "fileProperty",
        "fileObject",
        "fileSet",
        "format",
        "includes",
        "isLiveDataset",
        "jsonPath",
        "key",
        "md5",
        "parentField",
        "path",
        "recordSet",
        "references",
        "regex",
        "repeated",
        "replace",
        "samplingRate",
        "separator",
        "source",
        "subField",
        "transform",
    ];
    let mut context = json!({
        "@language": "en",
        "@vocab": "https://schema.org/",
        "conformsTo": "dct:conformsTo",
        "cr": "http://mlcommons.org/croissant/",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "data": {"@id": "cr:data", "@type": "@json"},
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
        "dct": "http://purl.org/dc/terms/",
        "examples": {"@id": "cr:examples", "@type": "@json"},
        "sc": "https://schema.org/",
    });
    for term in terms {
        context[term] = json!(format!("cr:{term}"));
    }
    context
}
