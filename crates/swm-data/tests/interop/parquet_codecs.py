"""Writes `parquet-codecs/NAME.parquet` beside this file: the rows of the first episode of `lerobot-v21`, each file with another
compression, `mixed.parquet` with two, and two files with other pages. Needs pyarrow.

    python parquet_codecs.py
"""

from pathlib import Path

import pyarrow.parquet as pq

here = Path(__file__).parent
table = pq.read_table(here / "lerobot-v21/data/chunk-000/episode_000000.parquet")
(here / "parquet-codecs").mkdir(exist_ok=True)
for codec in ["none", "snappy", "zstd", "gzip", "brotli", "lz4"]:
    pq.write_table(table.replace_schema_metadata(), here / f"parquet-codecs/{codec}.parquet", compression=codec)
mixed = {name: "gzip" if name == "next.reward" else "zstd" for name in table.column_names}
for name in ["action", "observation.state"]:
    mixed[f"{name}.list.element"] = mixed.pop(name)
pq.write_table(table.replace_schema_metadata(), here / "parquet-codecs/mixed.parquet", compression=mixed)

# Pages with checksums, and a page whose header states fewer bytes than its values take.
plain = {"compression": "none", "use_dictionary": False}
pq.write_table(table.replace_schema_metadata(), here / "parquet-codecs/checked.parquet", write_page_checksum=True, **plain)
short = here / "parquet-codecs/short.parquet"
pq.write_table(table.replace_schema_metadata(), short, use_byte_stream_split=["next.reward"], **plain)
group = pq.ParquetFile(short).metadata.row_group(0)
columns = [group.column(index) for index in range(group.num_columns)]
start = next(column.data_page_offset for column in columns if column.path_in_schema == "next.reward")
data = bytearray(short.read_bytes())
header = data[start : start + 16]
# Two fields of Thrift's compact protocol: the uncompressed and the compressed size, as zigzag numbers of one byte.
size = header.index(0x15, 1)
assert header[size + 2] == 0x15 and header[size + 1] == header[size + 3], header.hex()
for at in (size + 1, size + 3):
    data[start + at] -= 16
short.write_bytes(data)
