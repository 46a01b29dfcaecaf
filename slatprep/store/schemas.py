"""The JSON Schemas of the records, made from their classes.

    python -m slatprep.store.schemas

writes them into ``slatprep/store/schema``, where they are published.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from slatprep.store.record import BuildRecord, Record
from slatprep.store.record_json import adapter_of

FOLDER = Path(__file__).with_name("schema")


def json_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema (draft 2020-12) of each kind of record, by its file's name."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    adapters = {
        "asset_record.schema.json": ("slatprep asset record", adapter_of(Record)),
        "build_record.schema.json": ("slatprep build record", adapter_of(BuildRecord)),
    }
    schemas: dict[str, dict[str, Any]] = {}
    for name, (title, adapter) in adapters.items():
        schema = {"$schema": dialect, **adapter.json_schema(), "title": title}
        schemas[name] = json.loads(json.dumps(schema))  # Defaults may be tuples.
    return schemas


if __name__ == "__main__":
    for name, schema in json_schemas().items():
        (FOLDER / name).write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")
