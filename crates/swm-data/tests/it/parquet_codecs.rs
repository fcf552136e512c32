//! LeRobot tables in every compression of Parquet (`tests/interop/parquet_codecs.py`).

use crate::hostile::copied;
use crate::video::interop;
use swm_core::Result;
use swm_data::{StepRange, open};

/// A column of the first episode of a dataset, whose table has this compression.
fn column(codec: &str, name: &str) -> Result<Vec<u8>> {
    let (_folder, path) = copied("lerobot-v21");
    let table = path.join("data/chunk-000/episode_000000.parquet");
    let copied = std::fs::copy(interop().join(format!("parquet-codecs/{codec}.parquet")), table);
    copied.expect("copying the table");
    let read = open(&path)?.read(&[name], &[StepRange::new(0, 0, 11)])?;
    Ok(read.bytes(0).to_vec())
}

fn state(codec: &str) -> Result<Vec<u8>> {
    column(codec, "proprio")
}

#[test]
fn compressions_are_read_or_named() {
    let expected = state("snappy").expect("as LeRobot writes");
    for codec in ["none", "zstd"] {
        assert_eq!(state(codec).expect(codec), expected, "{codec}");
    }
    for codec in ["gzip", "brotli", "lz4"] {
        let error = state(codec).expect_err(codec).to_string();
        assert!(error.contains(&format!("compressed with {codec}, which is not read")), "{codec}: {error}");
        assert!(error.contains("snappy, zstd and none are") && error.contains("episode_000000.parquet"), "{error}");
        assert!(error.contains("pyarrow") && !error.contains("damaged") && !error.contains("copy"), "{error}");
    }
}

#[test]
fn columns_that_are_not_read_may_have_any_compression() {
    assert_eq!(column("mixed", "proprio").expect("zstd"), column("snappy", "proprio").expect("as LeRobot writes"));
    let error = column("mixed", "next.reward").expect_err("gzip").to_string();
    assert!(error.contains("column 'next.reward' is compressed with gzip, which is not read"), "{error}");
}

#[test]
fn checksums_of_pages_are_compared() {
    assert_eq!(state("checked").expect("whole pages"), state("snappy").expect("as LeRobot writes"));
    let (_folder, path) = copied("lerobot-v21");
    let table = path.join("data/chunk-000/episode_000000.parquet");
    let mut bytes = std::fs::read(interop().join("parquet-codecs/checked.parquet")).expect("the table");
    let whole = state("snappy").expect("as LeRobot writes");
    let at = bytes.windows(whole.len()).position(|bytes| bytes == whole).expect("a page of the state");
    bytes[at + 11] ^= 0x80;
    std::fs::write(&table, bytes).expect("writing the table");
    let read = open(&path).and_then(|reader| reader.read(&["proprio"], &[StepRange::new(0, 0, 11)]).map(drop));
    let error = read.expect_err("another sign").to_string();
    assert!(error.contains("checksum") && error.contains("episode_000000.parquet"), "{error}");
}

#[test]
fn page_with_fewer_bytes_than_values_is_an_error() {
    let error = column("short", "next.reward").expect_err("seven of eleven values").to_string();
    assert!(error.contains("the table is damaged") && error.contains("episode_000000.parquet"), "{error}");
}
