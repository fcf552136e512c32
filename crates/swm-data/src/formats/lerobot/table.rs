//! Reads and writes Parquet files.

use super::info::damaged;
use arrow_array::cast::AsArray as _;
use arrow_array::{Array, RecordBatch};
use arrow_schema::Schema as ArrowSchema;
use parquet::arrow::arrow_reader::{ArrowReaderOptions, ParquetRecordBatchReaderBuilder, RowSelection};
use parquet::arrow::{ArrowWriter, ProjectionMask};
use parquet::basic::Compression;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use std::io::Write as _;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use swm_core::{Error, Result, files};

/// The most rows per byte of a file. A file of equal values, which are stored as runs, has a few thousand.
const MAX_ROWS_PER_BYTE: u64 = 1 << 14;

/// Rows per decoded batch.
const ROWS: usize = 4096;

/// Reads columns of a file: all rows, or ascending ranges of rows. The result lacks the columns that do not exist.
///
/// # Errors
/// If the file cannot be read or is damaged, including when the Parquet library panics.
pub fn read(path: &Path, columns: &[&str], rows: Option<Vec<Range<usize>>>) -> Result<Vec<RecordBatch>> {
    if !path.exists() {
        return Err(damaged(path, "the file is missing".to_owned()));
    }
    let file = files::open(path)?;
    let length = file.metadata().map_err(|e| Error::io(path, "opening a table", e))?.len();
    let failed = |e: &dyn std::fmt::Display| damaged(path, format!("the table is damaged: {e}"));
    let work = || -> Result<Vec<RecordBatch>> {
        // Ignores the Arrow schema that other programs embed, because it is redundant and could be damaged.
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let builder = ParquetRecordBatchReaderBuilder::try_new_with_options(file, options).map_err(|e| failed(&e))?;
        let total = usize::try_from(builder.metadata().file_metadata().num_rows()).map_err(|e| failed(&e))?;
        if total as u64 > MAX_ROWS_PER_BYTE.saturating_mul(length) {
            return Err(failed(&format!("{total} rows do not fit {length} bytes")));
        }
        let fields = builder.parquet_schema().root_schema().get_fields();
        let column_indices: Vec<usize> =
            columns.iter().filter_map(|name| fields.iter().position(|field| field.name() == *name)).collect();
        let mask = ProjectionMask::roots(builder.parquet_schema(), column_indices);
        let mut builder = builder.with_projection(mask).with_batch_size(ROWS);
        if let Some(rows) = rows {
            if rows.last().is_some_and(|range| range.end > total) {
                return Err(failed(&format!("it has {total} rows")));
            }
            builder = builder.with_row_selection(RowSelection::from_consecutive_ranges(rows.into_iter(), total));
        }
        let reader = builder.build().map_err(|e| failed(&e))?;
        reader.map(|batch| batch.map_err(|e| failed(&e))).collect()
    };
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| Err(failed(&"its content is invalid")))
}

/// The values of an integer column.
///
/// # Errors
/// If there is no such column, or the column has another type.
pub fn integers(path: &Path, batches: &[RecordBatch], column: &str) -> Result<Vec<i64>> {
    let mut integers = vec![];
    for batch in batches {
        let values = batch.column_by_name(column).and_then(|array| {
            array.as_primitive_opt::<arrow_array::types::Int64Type>().filter(|array| array.null_count() == 0)
        });
        let values = values.ok_or_else(|| damaged(path, format!("it has no integer column '{column}'")))?;
        integers.extend_from_slice(values.values());
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
