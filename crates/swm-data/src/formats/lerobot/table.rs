//! Reads and writes Parquet files.

use super::info::damaged;
use crate::formats::system_error::system_error;
use arrow_array::cast::AsArray as _;
use arrow_array::types::{Int32Type, Int64Type};
use arrow_array::{Array, RecordBatch};
use arrow_schema::Schema as ArrowSchema;
use parquet::arrow::arrow_reader::{ArrowReaderOptions, ParquetRecordBatchReaderBuilder, RowSelection};
use parquet::arrow::{ArrowWriter, ProjectionMask};
use parquet::basic::Compression;
use parquet::file::metadata::{ColumnChunkMetaData, KeyValue, RowGroupMetaData};
use parquet::file::properties::WriterProperties;
use parquet::schema::types::SchemaDescriptor;
use std::io::Write as _;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use swm_core::guarded::guarded;
use swm_core::{Error, Result, files};

/// The most rows per byte of a file. A file of equal values, which are stored as runs, has a few thousand.
const MAX_ROWS_PER_BYTE: u64 = 1 << 14;

/// The most rows of a decoded batch.
const ROWS: usize = 4096;

/// The size of a decoded batch, in bytes of the columns that it is read for.
const BATCH_BYTES: usize = 16 << 20;

/// The most bytes of a table that is read as a whole.
const TABLE_BYTES: usize = 1 << 30;

/// A row of a table that is read as a whole has fewer bytes, if it is not made to fill the memory.
const TABLE_ROW_BYTES: usize = 1 << 16;

/// Reads columns of a small file: all rows. The result lacks the columns that do not exist.
///
/// # Errors
/// As [`read_batches`], and if the rows take more than a GiB: a small file can repeat a long text in many rows.
pub fn read(path: &Path, columns: &[&str]) -> Result<Vec<RecordBatch>> {
    read_within(path, columns, TABLE_BYTES)
}

/// As [`read`], with another bound in bytes.
fn read_within(path: &Path, columns: &[&str], most: usize) -> Result<Vec<RecordBatch>> {
    let (mut batches, mut bytes) = (vec![], 0);
    read_batches(path, columns, None, TABLE_ROW_BYTES, &mut |batch| {
        bytes += batch.get_array_memory_size();
        if bytes > most {
            return Err(damaged(path, format!("its rows take more than {most} bytes")));
        }
        batches.push(batch);
        Ok(())
    })?;
    Ok(batches)
}

/// Reads columns of a file, all rows or ascending ranges of rows, and calls `each` with every batch of some rows. A row has about
/// `row_bytes` bytes: a small file can hold many rows, which do not fit into memory together. The batches lack the columns
/// that do not exist.
///
/// # Errors
/// If the file cannot be read or is damaged, including when the Parquet library panics, and those of `each`.
pub fn read_batches(
    path: &Path,
    columns: &[&str],
    rows: Option<Vec<Range<usize>>>,
    row_bytes: usize,
    each: &mut dyn FnMut(RecordBatch) -> Result<()>,
) -> Result<()> {
    if !files::exists(path)? {
        return Err(damaged(path, "the file is missing".to_owned()));
    }
    let file = files::open(path)?;
    let length = file.metadata().map_err(|e| Error::io(path, "opening a table", e))?.len();
    let broken = |problem: &dyn std::fmt::Display| damaged(path, format!("the table is damaged: {problem}"));
    // The errors of the library, which reads the file.
    let failed = |e: &dyn std::fmt::Display| match system_error(&e.to_string()) {
        Some(error) => Error::io(path, "reading the table", error),
        None => broken(e),
    };
    let is_read = |name: &String| columns.contains(&name.as_str());
    let work = || -> Result<()> {
        // Ignores the Arrow schema that other programs embed, because it is redundant and could be damaged.
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let builder = ParquetRecordBatchReaderBuilder::try_new_with_options(file, options).map_err(|e| failed(&e))?;
        let total = usize::try_from(builder.metadata().file_metadata().num_rows()).map_err(|e| broken(&e))?;
        if total as u64 > MAX_ROWS_PER_BYTE.saturating_mul(length) {
            return Err(broken(&format!("{total} rows do not fit {length} bytes")));
        }
        if builder.metadata().row_groups().iter().flat_map(RowGroupMetaData::columns).any(is_outside) {
            return Err(broken(&"a column begins before the file, or has a negative size"));
        }
        check_compression(path, builder.metadata().row_groups(), is_read)?;
        // Rows of the declared shape have fewer values than bytes.
        let is_larger = |group: &RowGroupMetaData| {
            let read = group.columns().iter().filter(|c| c.column_path().parts().first().is_some_and(is_read));
            let most = group.num_rows().saturating_mul(i64::try_from(row_bytes).unwrap_or(i64::MAX));
            row_bytes > 0 && read.map(ColumnChunkMetaData::num_values).any(|values| values > most)
        };
        if builder.metadata().row_groups().iter().any(is_larger) {
            return Err(broken(&"its rows have more values than the dataset declares"));
        }
        let column_indices = positions(builder.parquet_schema(), columns).map_err(|problem| broken(&problem))?;
        let mask = ProjectionMask::roots(builder.parquet_schema(), column_indices);
        let mut builder =
            builder.with_projection(mask).with_batch_size((BATCH_BYTES / row_bytes.max(1)).clamp(1, ROWS));
        if let Some(rows) = rows {
            if rows.last().is_some_and(|range| range.end > total) {
                return Err(broken(&format!("it has {total} rows")));
            }
            builder = builder.with_row_selection(RowSelection::from_consecutive_ranges(rows.into_iter(), total));
        }
        let reader = builder.build().map_err(|e| failed(&e))?;
        reader.into_iter().try_for_each(|batch| each(batch.map_err(|e| failed(&e))?))
    };
    guarded(work).unwrap_or_else(|panic| Err(broken(&panic)))
}

/// The positions of columns in a table.
///
/// # Errors
/// If two columns of the table have one of the names.
fn positions(table: &SchemaDescriptor, columns: &[&str]) -> Result<Vec<usize>, String> {
    let fields = table.root_schema().get_fields();
    let mut found: Vec<usize> = vec![];
    for (position, field) in fields.iter().enumerate().filter(|(_, field)| columns.contains(&field.name())) {
        if found.iter().any(|&earlier| fields[earlier].name() == field.name()) {
            return Err(format!("it has two columns '{}'", field.name()));
        }
        found.push(position);
    }
    Ok(found)
}

/// Checks that the columns that are read have a compression that this build reads.
fn check_compression(path: &Path, groups: &[RowGroupMetaData], is_read: impl Fn(&String) -> bool) -> Result<()> {
    for column in groups.iter().flat_map(RowGroupMetaData::columns) {
        let Some(name) = column.column_path().parts().first().filter(|name| is_read(name)) else { continue };
        let compression = match column.compression() {
            Compression::UNCOMPRESSED | Compression::SNAPPY | Compression::ZSTD(_) => continue,
            Compression::GZIP(_) => "gzip",
            Compression::BROTLI(_) => "brotli",
            Compression::LZ4 | Compression::LZ4_RAW => "lz4",
            Compression::LZO => "lzo",
        };
        let problem =
            format!("column '{name}' is compressed with {compression}, which is not read (snappy, zstd and none are)");
        let fix = "write the file again with pyarrow.parquet.write_table(pyarrow.parquet.read_table(FILE), FILE)";
        return Err(Error::corrupt(path, problem, fix));
    }
    Ok(())
}

/// Whether a column begins before the file or has a negative size, at which the library panics.
fn is_outside(column: &ColumnChunkMetaData) -> bool {
    let is_negative = |number: i64| number < 0;
    is_negative(column.data_page_offset())
        || is_negative(column.compressed_size())
        || column.dictionary_page_offset().is_some_and(is_negative)
}

/// The values of an integer column of 64 or 32 bits.
///
/// # Errors
/// If there is no such column, or the column has another type.
pub fn integers(path: &Path, batches: &[RecordBatch], column: &str) -> Result<Vec<i64>> {
    let mut integers = vec![];
    for batch in batches {
        let array = batch.column_by_name(column).filter(|array| array.null_count() == 0);
        let long = array.and_then(|array| array.as_primitive_opt::<Int64Type>());
        match (long, array.and_then(|array| array.as_primitive_opt::<Int32Type>())) {
            (Some(values), _) => integers.extend_from_slice(values.values()),
            (_, Some(values)) => integers.extend(values.values().iter().map(|&value| i64::from(value))),
            _ => return Err(damaged(path, format!("it has no integer column '{column}'"))),
        }
    }
    Ok(integers)
}

/// Writes a table to a file atomically.
///
/// # Errors
/// If writing fails.
pub fn write(path: &Path, schema: &Arc<ArrowSchema>, batch: &RecordBatch) -> Result<()> {
    let failed = |e: parquet::errors::ParquetError| Error::external(format!("writing {}", path.display()), e);
    // Other readers expect the schema's metadata in the Parquet key-value metadata.
    let metadata = schema.metadata().iter().map(|(key, value)| KeyValue::new(key.clone(), value.clone())).collect();
    let properties =
        WriterProperties::builder().set_compression(Compression::SNAPPY).set_key_value_metadata(Some(metadata)).build();
    let mut bytes = vec![];
    let mut writer = ArrowWriter::try_new(&mut bytes, Arc::clone(schema), Some(properties)).map_err(failed)?;
    writer.write(batch).map_err(failed)?;
    writer.close().map_err(failed)?;
    write_atomically(path, &bytes)
}

/// Writes a file atomically: to a temporary file that is then renamed.
///
/// # Errors
/// If writing fails.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    let io = |e| Error::io(path, "writing a file of the dataset", e);
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(io)?;
    }
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".tmp");
    files::open_to_write(temporary.as_ref(), false)?.write_all(bytes).map_err(io)?;
    std::fs::rename(&temporary, path).map_err(io)
}

#[cfg(test)]
mod tests {
    use super::*;
    use arrow_array::{Int32Array, Int64Array, StringArray};
    use arrow_schema::{DataType, Field};

    #[test]
    fn texts_that_many_rows_repeat_are_bounded() {
        let folder = tempfile::tempdir().expect("creating a folder");
        let path = folder.path().join("episodes.parquet");
        let schema = Arc::new(ArrowSchema::new(vec![Field::new("tasks", DataType::Utf8, false)]));
        let text = "a long text ".repeat(1000);
        let texts = Arc::new(StringArray::from_iter_values(std::iter::repeat_n(&text, 1000)));
        let batch = RecordBatch::try_new(Arc::clone(&schema), vec![texts]).expect("a table");
        write(&path, &schema, &batch).expect("writing the table");
        let length = std::fs::metadata(&path).expect("the file").len();
        assert!(length < 100_000, "the text is stored once, in {length} bytes");
        let error = read_within(&path, &["tasks"], 1 << 20).expect_err("12 MB").to_string();
        assert!(error.contains("its rows take more than 1048576 bytes"), "{error}");
        let rows = read_within(&path, &["tasks"], 1 << 26).expect("64 MB suffice");
        assert_eq!(rows.iter().map(RecordBatch::num_rows).sum::<usize>(), 1000);
    }

    #[test]
    fn integers_have_64_or_32_bits() {
        let read = |array: arrow_array::ArrayRef| {
            let batch = RecordBatch::try_from_iter([("episode_index", array)]).expect("a table");
            integers(Path::new("data.parquet"), &[batch], "episode_index").map_err(|error| error.to_string())
        };
        assert_eq!(read(Arc::new(Int32Array::from(vec![0, -1, 7]))), Ok(vec![0, -1, 7]));
        assert_eq!(read(Arc::new(Int64Array::from(vec![1 << 40]))), Ok(vec![1 << 40]));
        for array in [
            Arc::new(Int32Array::from(vec![Some(0), None])) as arrow_array::ArrayRef,
            Arc::new(StringArray::from(vec!["0"])),
        ] {
            let error = read(array).expect_err("no integers");
            assert!(error.contains("no integer column 'episode_index'"), "{error}");
        }
    }

    #[test]
    fn two_columns_of_one_name_are_refused() {
        let folder = tempfile::tempdir().expect("creating a folder");
        let path = folder.path().join("data.parquet");
        let field = |name: &str| Field::new(name, DataType::Utf8, false);
        let schema = Arc::new(ArrowSchema::new(vec![field("reward"), field("other"), field("other")]));
        let texts = |text: &str| -> arrow_array::ArrayRef { Arc::new(StringArray::from_iter_values([text])) };
        let columns = vec![texts("a"), texts("b"), texts("c")];
        let batch = RecordBatch::try_new(Arc::clone(&schema), columns).expect("a table");
        write(&path, &schema, &batch).expect("writing the table");
        assert_eq!(read(&path, &["reward"]).expect("one of these").len(), 1);
        let error = read(&path, &["reward", "other"]).expect_err("two of these").to_string();
        assert!(error.contains("two columns 'other'"), "{error}");
    }

    #[test]
    fn a_changed_bit_of_the_footer_is_an_error_without_a_panic() {
        let folder = tempfile::tempdir().expect("creating a folder");
        let path = folder.path().join("data.parquet");
        let schema = Arc::new(ArrowSchema::new(vec![Field::new("tasks", DataType::Utf8, false)]));
        let texts = Arc::new(StringArray::from_iter_values(["a", "b"]));
        let batch = RecordBatch::try_new(Arc::clone(&schema), vec![texts]).expect("a table");
        write(&path, &schema, &batch).expect("writing the table");
        let bytes = std::fs::read(&path).expect("the file");
        // The length of the footer and a mark end the file.
        let (rest, end) = bytes.split_at(bytes.len() - 8);
        let footer = u32::from_le_bytes([end[0], end[1], end[2], end[3]]) as usize;
        for bit in 8 * (rest.len() - footer)..8 * rest.len() {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            std::fs::write(&path, changed).expect("writing the file");
            if let Err(error) = read(&path, &["tasks"]) {
                assert!(!error.to_string().contains("panicked"), "a panic for bit {bit}: {error}");
            }
        }
    }
}
