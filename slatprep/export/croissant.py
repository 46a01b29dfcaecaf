"""Describe a store in Croissant, MLCommons' vocabulary for datasets.

The description is JSON-LD after the Croissant 1.0 specification
(http://mlcommons.org/croissant/1.0). Croissant cannot extract records from Zarr. The
description therefore only lists the arrays: files, shapes, types, meaning. It contains the
table of assets, the classes and the ranges as records.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from slatprep.errors import ConfigError, StoreError, printable
from slatprep.export.formats import COLUMNS
from slatprep.records import MATERIAL_CLASSES, PROPERTIES, Contents
from slatprep.storage.documents import parse_document, read_bounded
from slatprep.store import Store
from slatprep.store.contract import MAX_METADATA_BYTES

CONFORMS_TO = "http://mlcommons.org/croissant/1.0"

_TERMS = (
    "citeAs column equivalentProperty extract field fileProperty fileObject fileSet format "
    "includes isLiveDataset jsonPath key md5 parentField path recordSet references regex "
    "repeated replace samplingRate separator source subField transform"
)
"""Croissant's terms without further attributes."""

# The context of the specification. The package mlcroissant writes it too, but would be needed
# for nothing else and depends on pandas.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS.split()},
}

ZARR = "https://zarr-specs.readthedocs.io/en/latest/v3/core/index.html"
"""The format of Zarr's files; no media type is registered for it."""


_FORMS = {
    "url": (r"https?://\S+", "a page such as https://example.org/data"),
    "license": (r"https?://\S+|[\w.+-]+", "an SPDX identifier such as CC-BY-4.0, or a URL"),
    "version": (r"\d+\.\d+\.\d+([-+]\S+)?", "three numbers such as 1.0.0"),
}
"""What stated texts must look like."""


@dataclass(frozen=True)
class Stated:
    """Metadata of a dataset that its store does not hold; empty if not known.

    Attributes
    ----------
    name, url, cite_as, version : str
        Name, home page, citation, version.
    license : str
        An SPDX identifier, such as ``CC-BY-4.0``, or the URL of a licence.
    date_published : str
        Year, month and day, as ``2026-01-31``; a time may follow.
    """

    name: str = ""
    license: str = ""
    url: str = ""
    cite_as: str = ""
    version: str = "1.0.0"
    date_published: str = ""

    def __post_init__(self) -> None:
        for name, (form, expected) in _FORMS.items():
            text = getattr(self, name)
            if text and not re.fullmatch(form, text):
                raise ConfigError(f"{name} is {text!r}; expected {expected}")
        if self.date_published and not _is_day(self.date_published):
            raise ConfigError(
                f"date_published is {self.date_published!r}; expected a day such as 2026-01-31"
            )

    @property
    def missing(self) -> tuple[str, ...]:
        """Options for metadata that catalogues ask for and that are not stated."""
        asked = ("license", "cite_as", "url", "date_published")
        return tuple(f"--{name.replace('_', '-')}" for name in asked if not getattr(self, name))

    @property
    def license_url(self) -> str:
        """The URL of the licence."""
        if not self.license or "://" in self.license:
            return self.license
        return f"https://spdx.org/licenses/{self.license}"


def _is_day(text: str) -> bool:
    try:
        return datetime.fromisoformat(text).date().isoformat() == text[:10]
    except ValueError:
        return False


def describe(store: Store, stated: Stated | None = None, location: str = "") -> dict[str, Any]:
    """Describe a store as a Croissant dataset: JSON-LD, JSON-ready, the same for the same store.

    `location` is the path or URL of the store for readers; by default its name. Croissant's
    validator warns of metadata that `stated` leaves empty.
    """
    location, stated = location or store.name, stated or Stated()
    more = {
        "description": description_of(store.contents),
        "license": stated.license,
        "url": stated.url,
        "citeAs": stated.cite_as,
        "version": stated.version,
        "datePublished": stated.date_published,
    }
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": stated.name or store.name.removesuffix(".zarr"),
        **{key: value for key, value in more.items() if value},
        "keywords": ["3D", "physics", "material properties", "structured latents", "Zarr"],
        "distribution": _distribution(store, location),
        "recordSet": [
            *([_classes(store)] if store.contents.classes else []),
            _properties(store),
            _assets(store),
        ],
    }


def description_of(contents: Contents) -> str:
    """Return a sentence on the contents of a store."""
    names = [one.title for one in contents.properties] + ["material class"] * bool(contents.classes)
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    pixieverse = (contents.properties, contents.classes) == (PROPERTIES, MATERIAL_CLASSES)
    return (
        f"{'PixieVerse material' if pixieverse else 'Material'} fields aligned with structured "
        f"latents (encoder {contents.latents.encoder}): for every latent voxel its {listed}, "
        "normalised, with the transform between the two frames and how far it can be trusted."
    )


def _distribution(store: Store, location: str) -> list[dict[str, Any]]:
    """Describe the root's metadata as a file, and each array as a set of files."""
    content = _root_of(store)
    root = {
        "@type": "cr:FileObject",
        "@id": "store",
        "name": "store",
        "description": f"Root of the Zarr store, format {store.attributes['format']} "
        f"{store.attributes['format_version']}: attributes and the metadata of all arrays.",
        "contentUrl": f"{location}/zarr.json",
        "contentSize": f"{len(content)} B",
        "encodingFormat": "application/json",
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    arrays = sorted(entry for entry in store.metadata.items() if entry[1]["node_type"] == "array")
    return [root, *(_file_set(name, array, location) for name, array in arrays)]


def _root_of(store: Store) -> bytes:
    """Return the root's metadata as they lie there; StoreError if they are not what was opened."""
    _ = store.group  # It refuses metadata that zarr-python could not read.
    path = store.path / "zarr.json"
    try:
        content = read_bounded(path, MAX_METADATA_BYTES)
        document = parse_document(content)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error
    if document != store.document:
        raise StoreError(f"{path}: is not what was opened (was the store replaced?); open it again")
    return content


def _file_set(name: str, array: Mapping[str, Any], location: str) -> dict[str, Any]:
    attributes, shape = array.get("attributes", {}), array["shape"]
    names = array.get("dimension_names") or ("dimension",) * len(shape)
    dimensions = ", ".join(f"{n} {size}" for n, size in zip(names, shape, strict=True))
    kind = "str" if array["data_type"] == "string" else array["data_type"]
    units = f" [{attributes['units']}]" if "units" in attributes else ""
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": f"{attributes.get('description', '')}{units}. "
        f"Zarr array of {kind}: {dimensions}.",
        "encodingFormat": ZARR,
        "includes": f"{location}/{name}/**",
    }


def _record_set(
    name: str,
    description: str,
    fields: Mapping[str, tuple[str, str]],
    rows: Iterable[Iterable[Any]],
    **more: Any,
) -> dict[str, Any]:
    """Describe a table: type and meaning of each field, the first of which is the key."""
    ids = [f"{name}/{field}" for field in fields]
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": description,
        **more,
        "key": {"@id": ids[0]},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{field}",
                "name": field,
                "description": meaning,
                "dataType": kind,
            }
            for field, (kind, meaning) in fields.items()
        ],
        "data": [dict(zip(ids, row, strict=True)) for row in rows],
    }


def _classes(store: Store) -> dict[str, Any]:
    classes = store.contents.classes
    whose = "PhysGaussian's material" if classes == MATERIAL_CLASSES else "Material"
    return _record_set(
        "materials",
        f"{whose} classes, the values of voxel/material and grid/material.",
        {"id": ("sc:Integer", "value in the arrays"), "name": ("sc:Text", "name of the class")},
        enumerate(classes),
        dataType="sc:Enumeration",
    )


def _properties(store: Store) -> dict[str, Any]:
    ranges = zip(store.normalization.ranges, store.contents.properties, strict=True)
    return _record_set(
        "properties",
        "The columns of voxel/properties and the channels of grid/properties. A normalised value "
        "v is m = lo + (v + 1) / 2 * (hi - lo) in SI units, or 10**m where log10 is true.",
        {
            "name": ("sc:Text", "name of the property"),
            "unit": ("sc:Text", "SI unit"),
            "log10": ("sc:Boolean", "whether lo and hi are log10 of it"),
            "lo": ("sc:Float", "value that becomes -1"),
            "hi": ("sc:Float", "value that becomes 1"),
        },
        ((one.name, of.unit, one.log10, one.lo, one.hi) for one, of in ranges),
    )


def _assets(store: Store) -> dict[str, Any]:
    fields, columns = {}, []
    for name in ("id", *COLUMNS):
        column = store.column(name)
        kind = "sc:Float" if column.dtype.kind == "f" else "sc:Text"
        fields[name] = kind, store.metadata[f"asset/{name}"]["attributes"].get("description", "")
        # JSON has no NaN, which is the only value that differs from itself.
        columns.append([value if value == value else None for value in column.tolist()])
    fields["first_row"] = "sc:Integer", "its first row of voxel/*"
    fields["end_row"] = "sc:Integer", "the row after its last"
    offsets = store.offsets.tolist()
    rows = zip(*columns, offsets[:-1], offsets[1:], strict=True)
    description = "One row per asset: what it is, and how good its alignment is."
    return _record_set("assets", description, fields, rows)


def to_json(description: Mapping[str, Any]) -> str:
    """Return a description as the text of a file."""
    return printable(json.dumps(description, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
