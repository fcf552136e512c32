//! The pages of the lab, which `make lab-assets` builds from `web/` with Vite. The built files are committed and embedded.

use flate2::Compression;
use flate2::write::GzEncoder;
use std::io::Write as _;
use std::sync::OnceLock;

/// An embedded file.
pub struct Asset {
    /// The path, without a leading `/`.
    pub path: &'static str,
    /// The media type.
    pub kind: &'static str,
    /// The content.
    pub bytes: &'static [u8],
    /// The content, compressed.
    pub gzip: Vec<u8>,
}

/// Path, media type, content.
type Embedded = (&'static str, &'static str, &'static [u8]);

const FILES: [Embedded; 4] = [
    ("index.html", "text/html; charset=utf-8", include_bytes!("../assets/index.html")),
    ("lab.js", "text/javascript; charset=utf-8", include_bytes!("../assets/lab.js")),
    ("licences.txt", "text/plain; charset=utf-8", include_bytes!("../assets/licences.txt")),
    ("lab.css", "text/css; charset=utf-8", include_bytes!("../assets/lab.css")),
];

/// All embedded files.
pub fn all() -> &'static [Asset] {
    static ALL: OnceLock<Vec<Asset>> = OnceLock::new();
    ALL.get_or_init(|| {
        FILES.iter().map(|&(path, kind, bytes)| Asset { path, kind, bytes, gzip: gzip(bytes) }).collect()
    })
}

/// The file with this path; the page for the empty path.
pub fn find(path: &str) -> Option<&'static Asset> {
    let path = if path.is_empty() { "index.html" } else { path };
    all().iter().find(|asset| asset.path == path)
}

/// Compresses bytes. Writing to memory does not fail; the result would be empty.
fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(vec![], Compression::best());
    encoder.write_all(bytes).and_then(|()| encoder.finish()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The largest size of all files together, compressed.
    const MOST: usize = 500_000;

    #[test]
    fn pages_are_small_and_name_no_other_host() {
        let total: usize = all().iter().map(|asset| asset.gzip.len()).sum();
        assert!(total > 1_000 && total < MOST, "{total} bytes");
        for asset in all() {
            let text = String::from_utf8_lossy(asset.bytes);
            let urls = text
                .split("//")
                .skip(1)
                .filter(|rest| !rest.starts_with(['/', ' ']))
                .map(|rest| rest.split(['"', '\'', '`', ' ']).next());
            // The namespaces of SVG, MathML and XML name no address that is opened.
            let foreign: Vec<_> =
                urls.flatten().filter(|url| url.contains('.') && !url.starts_with("www.w3.org/")).collect();
            assert!(foreign.is_empty(), "{}: {foreign:?}", asset.path);
        }
    }
}
