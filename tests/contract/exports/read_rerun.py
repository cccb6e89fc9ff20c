"""Program: print the content of a Rerun file as JSON, entity → list of time [ns] and value. Argument: the file."""

import json
import sys

import pyarrow as pa
from rerun.chunk import RrdReader

TIMELINE = "session"
content: dict[str, list[tuple[int, object]]] = {}
for chunk in RrdReader(sys.argv[1]).stream():
    batch = chunk.to_record_batch()
    if TIMELINE not in batch.schema.names:
        continue
    times = batch.column(TIMELINE).cast(pa.int64()).to_pylist()
    for name in ("Scalars:scalars", "EncodedImage:blob", "TextLog:text"):
        if name in batch.schema.names:
            values = batch.column(name).to_pylist()
            content.setdefault(chunk.entity_path, []).extend(zip(times, [value[0] for value in values], strict=True))
sys.stdout.write(json.dumps({path: sorted(values, key=lambda each: each[0]) for path, values in content.items()}))
