"""Write the JSON Schemas of the records from their classes: `python tools/schema.py`."""

from __future__ import annotations

import argparse
import json
from typing import Annotated, Any

from pydantic import Field

from slatprep.storage.documents import adapter_of
from slatprep.store.record import BuildRecord, Record
from slatprep.store.record_json import FOLDER

KINDS = {"asset": Annotated[Record, Field(discriminator="status")], "build": BuildRecord}


def json_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema (draft 2020-12) of each kind of record, by its file's name."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    schemas = {}
    for name, kind in KINDS.items():
        title = f"slatprep {name} record"
        schema = {"$schema": dialect, **adapter_of(kind).json_schema(), "title": title}
        # The round trip turns tuples among the defaults into lists.
        schemas[f"{name}_record.schema.json"] = json.loads(json.dumps(schema))
    return schemas


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    for name, schema in json_schemas().items():
        (FOLDER / name).write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")
