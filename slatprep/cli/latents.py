"""Read the latents of a file, a folder of files, or a store, for a command."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal

from slatprep.cli.output import Output
from slatprep.errors import ConfigError, InputError, StoreError

if TYPE_CHECKING:
    from slatprep.records import LatentMoments, LatentSpace, Place, StructuredLatents

Standardised = Annotated[
    Literal["auto", "yes", "no"],
    "Whether the latents of files are standardised already; auto: judged by their values.",
]

_ASKED = 8
"""Files that are read to tell whether latents have been standardised, where one does not."""


class LatentsReader:
    """Reads a source asset by asset; prints and skips latents that cannot be read.

    Raises
    ------
    ConfigError
        If there is no such asset, or a store's latents are from another encoder.
    """

    def __init__(
        self,
        output: Output,
        source: Place,
        assets: tuple[str, ...],
        space: LatentSpace,
        standardised: str,
    ) -> None:
        from slatprep.parameters import SlatSource
        from slatprep.readers import discover_slats
        from slatprep.store import open_store
        from slatprep.store.reader import is_store

        self.output, self.space, self.standardised = output, space, standardised
        self.store = open_store(source) if is_store(source) else None
        files = [] if self.store else discover_slats(SlatSource(root=source, encoder=space.encoder))
        self.files = {file.asset_id: file for file in files}
        there = self.store.ids if self.store else list(self.files)
        self.rows = {asset_id: row for row, asset_id in enumerate(there)}
        if self.store:
            chosen = {there[self.store.match(name)] for name in assets}
            _require_encoder(source, self.store.contents.latents, space)
        else:
            chosen = {_match(source, name, there) for name in assets}
        self.ids = [asset_id for asset_id in there if not assets or asset_id in chosen]
        self.done: list[str] = []
        self.problems: list[str] = []
        self.seconds = 0.0

    def __iter__(self) -> Iterator[StructuredLatents]:
        for asset_id in self.ids:
            begin = time.perf_counter()
            try:
                latents = self._latents(asset_id)
            except (InputError, StoreError) as error:
                self.leave_out(error)
                continue
            self.seconds += time.perf_counter() - begin
            self.done.append(asset_id)
            yield latents

    def leave_out(self, error: InputError | StoreError) -> None:
        """Print why an asset is left out, and count it."""
        self.problems.append(str(error))
        self.output.problem(f"slatprep: {error}")

    def _of_file(self, latents: StructuredLatents) -> StructuredLatents:
        """Return the latents of a file with `standardised` set."""
        from slatprep.readers import contents

        if self.standardised != "auto":
            return replace(latents, standardised=self.standardised == "yes")
        if not self._look_standardised(latents):
            return latents
        how = contents.in_words(latents.moments)
        self.output.note(
            f"{latents.sources[0].path}: its latents look standardised already ({how}) and are "
            "taken so; --standardised says otherwise"
        )
        return replace(latents, standardised=True)

    def _look_standardised(self, latents: StructuredLatents) -> bool:
        """Whether latents look standardised; asks the other files where they alone do not tell."""
        from slatprep.readers import contents

        moments = latents.moments
        if len(latents.coords) < contents.ENOUGH or contents.tell_alone(moments, self.space):
            return contents.look_standardised(moments, self.space)
        known = list(self._moments_of_files())
        if len(known) < 2:
            raise InputError(
                latents.sources[0].path,
                "one file alone does not tell whether its latents have been standardised "
                f"({contents.in_words(moments)})",
                "--standardised yes or no",
            )
        return contents.look_standardised(contents.pooled_moments(known), self.space)

    def _moments_of_files(self) -> Iterator[tuple[int, LatentMoments]]:
        """Yield voxels and moments of the first files that can be read."""
        from slatprep.readers.slat import read_slat

        for file in [one for one in self.files.values() if not one.problem][:_ASKED]:
            try:
                latents = read_slat(file.path, file.root, file.group, self.space)
            except (InputError, StoreError):
                continue
            yield len(latents.coords), latents.moments

    def _latents(self, asset_id: str) -> StructuredLatents:
        from slatprep.readers.slat import checked_latents, read_slat

        if self.store is None:
            file = self.files[asset_id]
            if file.problem:
                raise InputError(file.path, file.problem, "one SLAT an id")
            return self._of_file(read_slat(file.path, file.root, file.group, self.space))
        rows = self.store.read(self.rows[asset_id], ("coords", "feats"))
        space, where = self.store.contents.latents, f"{self.store.path} [{asset_id}]"
        latents = checked_latents(rows["coords"], rows["feats"], where, space=space)
        return replace(latents, standardised=space.standardised)


def _match(source: Place, name: str, ids: list[str]) -> str:
    """Return the id that `name` means, as `Store.match` does: itself, a beginning, or a number."""
    alike = [name] if name in ids else [known for known in ids if known.startswith(name)]
    if not alike and name.isascii() and name.isdigit() and int(name) < len(ids):
        return ids[int(name)]
    if len(alike) != 1:
        there = ", ".join(alike[:5]) if alike else f"it has {len(ids):,}"
        raise ConfigError(f"{source}: expected one SLAT with the id {name!r}; {there}")
    return alike[0]


def _size(space: LatentSpace, other: LatentSpace) -> str:
    """Say how wide latents are, and of which grid where the other's is not the same."""
    grid = "" if space.resolution == other.resolution else f", a grid of {space.resolution}^3"
    return f"{space.channels} channels{grid}"


def _require_encoder(source: Place, held: LatentSpace, space: LatentSpace) -> None:
    """Refuse latents of another encoder; equal widths and moments mean the same encoder."""
    same = (held.channels, held.resolution) == (space.channels, space.resolution)
    if not same or (held.encoder != space.encoder and held.mean != space.mean):
        raise ConfigError(
            f"{source} holds latents of {held.encoder} ({_size(held, space)}); expected those of "
            f"{space.encoder} ({_size(space, held)})"
        )
