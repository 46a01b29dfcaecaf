"""Read the latents of a source (a store, or files of TRELLIS and others) asset by asset."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.parameters import SlatSource
from slatprep.readers import contents, discover_slats
from slatprep.readers.plausible import ENOUGH
from slatprep.readers.slat import checked_latents, read_slat
from slatprep.records import LatentMoments, LatentSpace, Place, StructuredLatents
from slatprep.store import open_store
from slatprep.store.assets import match_id
from slatprep.store.reader import is_store

_ASKED = 8
"""Number of files read to find out whether latents are standardised, if one does not tell."""


class LatentsReader:
    """Reader of a source, a store or files, by asset; skips latents that cannot be read.

    `note` receives assumptions, and `problem` the reason why an asset is left out.

    Raises
    ------
    ConfigError
        If there is no such asset, or a store's latents are from another encoder.
    """

    def __init__(
        self,
        source: Place,
        assets: Sequence[str],
        space: LatentSpace,
        standardised: str,
        note: Callable[[str], None],
        problem: Callable[[str], None],
    ) -> None:
        self.space, self.standardised, self.note, self.problem = space, standardised, note, problem
        self.store = open_store(source) if is_store(source) else None
        if self.store:
            there = self.store.ids
            _require_encoder(source, self.store.contents.latents, space)
        else:
            slats = SlatSource(root=source, encoder=space.encoder)
            self.folder, self.slats = discover_slats(slats)
            there = list(self.slats)
        index = {asset_id: row for row, asset_id in enumerate(there)}
        chosen = {there[match_id(name, index, source)] for name in assets}
        self.ids = [asset_id for asset_id in there if not assets or asset_id in chosen]
        self.done: list[str] = []
        self.problems: list[str] = []
        self.seconds = 0.0

    def __iter__(self) -> Iterator[StructuredLatents]:
        for asset_id in self.ids:
            begin = time.perf_counter()
            try:
                latents = self._latents(asset_id)
                if not (latents.standardised or self.space.mean):
                    fault = "its latents are raw, and no mean and std of the encoder's are known"
                    raise InputError(asset_id, fault, "latents that are standardised already")
            except (InputError, StoreError) as error:
                self.leave_out(error)
                continue
            self.seconds += time.perf_counter() - begin
            self.done.append(asset_id)
            yield latents

    def leave_out(self, error: InputError | StoreError) -> None:
        """Report why an asset is left out, and keep the reason in `problems`."""
        self.problems.append(str(error))
        self.problem(f"slatprep: {error}")

    def _of_file(self, latents: StructuredLatents) -> StructuredLatents:
        """Return the latents of a file with `standardised` set."""
        if self.standardised == "auto" and not self.space.mean:
            raw = contents.tell_alone(latents.moments, self.space)
            return replace(latents, standardised=self.space.standardised and not raw)
        if self.standardised != "auto":
            return replace(latents, standardised=self.standardised == "yes")
        moments, path = latents.moments, latents.sources[0].path
        how = contents.in_words(moments)
        enough = len(latents.coords) >= ENOUGH
        if enough and not contents.tell_alone(moments, self.space):
            known = self._moments_of_files
            if len(known) < 2:
                raise InputError(
                    path,
                    f"one file alone does not tell whether its latents have been standardised "
                    f"({how})",
                    "--standardised yes or no",
                )
            moments = contents.pooled_moments(known)
        if not contents.look_standardised(moments, self.space):
            return latents
        self.note(
            f"{path}: its latents look standardised already ({how}) and are taken so; "
            "--standardised says otherwise"
        )
        return replace(latents, standardised=True)

    @cached_property
    def _moments_of_files(self) -> list[tuple[int, LatentMoments]]:
        """Number of voxels and moments of each of the first files that can be read."""
        known = []
        for slat in [one for one in self.slats.values() if not one.problem][:_ASKED]:
            with suppress(InputError, StoreError):
                latents = read_slat(self.folder / slat.path, self.folder, slat.group, self.space)
                known.append((len(latents.coords), latents.moments))
        return known

    def _latents(self, asset_id: str) -> StructuredLatents:
        if self.store is None:
            slat = self.slats[asset_id]
            path = self.folder / slat.path
            if slat.problem:
                raise InputError(path, slat.problem, "one SLAT an id")
            return self._of_file(read_slat(path, self.folder, slat.group, self.space))
        rows = self.store.read(asset_id, ("coords", "feats"))
        space, where = self.store.contents.latents, f"{self.store.path} [{asset_id}]"
        latents = checked_latents(rows["coords"], rows["feats"], where, space=space)
        return replace(latents, standardised=space.standardised)


def _size(space: LatentSpace, other: LatentSpace) -> str:
    """Return the number of channels in words, with the grid if it differs from the other's."""
    grid = "" if space.resolution == other.resolution else f", a grid of {space.resolution}^3"
    return f"{space.channels} channels{grid}"


def _require_encoder(source: Place, held: LatentSpace, space: LatentSpace) -> None:
    """Refuse latents of another encoder; equal channels, grid and means count as the same."""
    same = (held.channels, held.resolution) == (space.channels, space.resolution)
    if not same or (held.encoder != space.encoder and held.mean != space.mean):
        raise ConfigError(
            f"{source} holds latents of {held.encoder} ({_size(held, space)}); expected those of "
            f"{space.encoder} ({_size(space, held)})"
        )
