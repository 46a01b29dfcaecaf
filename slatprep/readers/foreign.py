"""Adapters of other packages: slatprep blames them for their errors and checks what they return.

They run unconfined, because the user installed them. A fault in one must not look like
slatprep's own, stop other assets, or get into a store.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar

import numpy as np
import orjson
from annotated_types import MaxLen, MinLen

from slatprep import records
from slatprep.errors import InputError, SlatprepError
from slatprep.geometry.frames import split_transform
from slatprep.geometry.voxels import flat_index
from slatprep.parameters import PixieverseSource
from slatprep.readers.plausible import coarse_places
from slatprep.readers.values import require_plausible
from slatprep.records.json_types import Count
from slatprep.records.tables import CLASS_NAME, MAX_PROPERTIES
from slatprep.storage.documents import faults_told, read_as
from slatprep.storage.files import Listing

_MOST_TOLD = 1000
"""Most bytes of an adapter's text in an error."""

_FILES = Annotated[tuple[records.SourceFile, ...], MinLen(1)]
_TEXTS = tuple[Annotated[str, MaxLen(4096)], ...]
_Read = TypeVar("_Read", records.MaterialField, records.StructuredLatents)


@dataclass(frozen=True)
class _Foreign:
    """An adapter of another package; errors name it, and its package with the version."""

    adapter: Any
    name: str
    package: str

    @contextmanager
    def _blamed(self) -> Iterator[None]:
        """Turn every error that is not slatprep's into an error that names the adapter."""
        try:
            yield
        except (SlatprepError, MemoryError):
            raise
        except (Exception, SystemExit, GeneratorExit) as error:  # It may raise anything.
            raise self._fault(f"raises {type(error).__name__}: {error}") from error

    def _fault(self, what: str) -> InputError:
        who = f"adapter {self.name!r} of {self.package}"
        # The adapter's text may be endless, or a terminal cannot show it.
        told = what.encode("utf-8", "backslashreplace")[:_MOST_TOLD].decode("utf-8", "ignore")
        return InputError(who, told, "what slatprep asks of an adapter; tell its makers")

    def _require(self, holds: object, what: str) -> None:
        if not holds:
            raise self._fault(f"gives {what}")

    def _require_arrays(self, of: object, *specs: tuple[str, type, tuple[int, ...]]) -> None:
        for name, dtype, shape in specs:
            got = np.asarray(getattr(of, name))
            self._require(
                got.dtype == dtype and got.shape == shape and 0 not in shape,
                f"{name} as {got.dtype} {got.shape}; expected {dtype.__name__} {shape}, not empty",
            )

    def _as_recorded(self, read: _Read, **kinds: Any) -> _Read:
        """Return what was read, with files, notes and entries of these kinds as in a record."""
        from pydantic import ValidationError

        held = {}
        for name, kind in {"sources": _FILES, "warnings": _TEXTS, **kinds}.items():
            try:
                held[name] = read_as(kind, orjson.dumps(getattr(read, name)))
            except (TypeError, ValueError) as error:
                told = faults_told(error) if isinstance(error, ValidationError) else (str(error),)
                reason = "; ".join(told[:3])
                raise self._fault(f"gives {name} that no record can hold: {reason}") from None
        return replace(read, **held)


class ForeignSource(_Foreign):
    """A source adapter; see `slatprep.readers.adapters.SourceAdapter`."""

    @property
    def patterns(self) -> Sequence[str]:
        """Return its patterns."""
        with self._blamed():
            return tuple(map(str, self.adapter.patterns))

    def describe(self, source: PixieverseSource) -> Any:
        """Return what the source holds."""
        with self._blamed():
            held = self.adapter.describe(source)
            classes = held.classes
            tables = held.properties, classes
            names = [one.name for one in held.properties if isinstance(one, records.Property)]
            self._require(all(isinstance(one, tuple) for one in tables), "lists, not tuples")
            self._require(
                0 < len(set(names)) == len(held.properties) <= MAX_PROPERTIES,
                f"{len(names)} properties; expected 1 to {MAX_PROPERTIES}, of a name each",
            )
            named = all(CLASS_NAME.fullmatch(one) for one in classes)
            self._require(named, f"classes {classes!r}")
            records.labels_of(classes)
            return held

    def find(self, source: PixieverseSource, listing: Listing) -> Iterator[Any]:
        """Yield its fields."""
        with self._blamed():
            every = iter(self.adapter.find(source, listing))
        while True:
            # Not around the yield: if the caller stops early, the adapter is not to blame.
            with self._blamed():
                if (found := next(every, None)) is None:
                    return
                texts = found.object_id, found.path, found.sample, found.problem
                named = all(isinstance(one, str) for one in (*texts, *found.beside))
                named = named and isinstance(found.beside, tuple)
                self._require(named, f"{found!r} as a field that it found")
            yield found

    def read(self, pair: records.AssetPair, max_unphysical: float) -> records.MaterialField:
        """Read a field and check it; convert and compare its values if the adapter did not."""
        with self._blamed():
            field: records.MaterialField = self.adapter.read(pair, max_unphysical)
            self._require(
                isinstance(field, records.MaterialField), f"{type(field).__name__} as a field"
            )
            rows, side, table = len(field.voxels), records.RESOLUTION, field.table
            self._require_arrays(
                field,
                ("occupancy", np.bool_, (side,) * 3),
                ("voxels", np.uint8, (rows, 3)),
                ("material", np.uint8, (rows,)),
                ("properties", np.float32, (rows, len(table))),
            )
            contents = pair.roots.contents
            whole = pair.roots.number == 0 and not pair.others
            known = tuple(one for one in contents.properties if one in table)
            self._require(
                table == (contents.properties if whole else known),
                "a table of properties other than it described",
            )
            self._require(field.voxels.max() < side, f"voxels above {side - 1}")
            cells = flat_index(field.voxels)
            self._require((np.diff(cells) > 0).all(), "voxels not each once in C order")
            there = field.occupancy.reshape(-1)[cells]
            self._require(there.all(), "annotated voxels that are not occupied")
            labels = len(contents.labels) if field.classified else 1
            self._require(field.material.max() < labels, f"classes above {labels - 1}")
            frame = np.eye(4) if field.frame is None else np.asarray(field.frame, np.float64)
            try:
                split_transform(frame)
            except ValueError as error:
                raise self._fault(f"gives a frame that is refused: {error}") from None
            field = self._as_recorded(field, unphysical=Count, bounds=Any)
        if not field.converted:
            where, values = pair.grid or pair.roots.pixieverse, field.properties.copy()
            material = field.material if field.classified else None
            told = coarse_places(field.voxels, side)
            told += require_plausible(where, values, material, table, pair.roots)
            warnings = (*field.warnings, *told)
            field = replace(field, properties=values, warnings=warnings, converted=True)
        for one, column in zip(table, field.properties.T, strict=True):
            self._require(one.physical(column).all(), f"values that are not {one.allowed}")
        return field


class ForeignLatents(_Foreign):
    """A latent adapter; see `slatprep.readers.adapters.LatentAdapter`."""

    @property
    def patterns(self) -> tuple[str, ...]:
        """Return its patterns, if it has any."""
        with self._blamed():
            return tuple(map(str, getattr(self.adapter, "patterns", ())))

    @property
    def space(self) -> records.LatentSpace:
        """Return the space of its latents."""
        with self._blamed():
            space: records.LatentSpace = self.adapter.space
            self._require(isinstance(space, records.LatentSpace), f"{space!r} as its space")
            named = space.encoder == self.name
            self._require(named, f"latents of {space.encoder!r}; expected its own name")
            return space

    def read(
        self, path: records.Place, root: records.Place, group: str, space: records.LatentSpace
    ) -> records.StructuredLatents:
        """Read a SLAT and check it."""
        with self._blamed():
            read: records.StructuredLatents = self.adapter.read(path, root, group, space)
            rows = len(read.coords)
            self._require_arrays(
                read, ("coords", np.uint8, (rows, 3)), ("feats", np.float32, (rows, space.channels))
            )
            side = space.resolution
            self._require(read.resolution == side, f"latents of a grid of {read.resolution}^3")
            self._require(read.coords.max() < side, f"coords above {side - 1}")
            once = len(np.unique(flat_index(read.coords, side))) == rows
            self._require(once, "a coordinate twice")
            self._require(np.isfinite(read.feats).all(), "feats that are not finite")
            told = f"{read.standardised!r} for whether they are standardised"
            self._require(type(read.standardised) is bool, told)
            return self._as_recorded(read)
