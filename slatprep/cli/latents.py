"""`slatprep extract-slat` and `decode-slat`, and how commands read latents."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal

from slatprep.cli.options import AssetIds, File, FileOrUrl, NewFolder, Whole
from slatprep.cli.output import Output
from slatprep.cli.signature import Click, command
from slatprep.errors import ConfigError, InputError, StoreError

if TYPE_CHECKING:
    from slatprep.extract import Session
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
        moments, path = latents.moments, latents.sources[0].path
        how = contents.in_words(moments)
        enough = len(latents.coords) >= contents.ENOUGH
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
        self.output.note(
            f"{path}: its latents look standardised already ({how}) and are taken so; "
            "--standardised says otherwise"
        )
        return replace(latents, standardised=True)

    @cached_property
    def _moments_of_files(self) -> list[tuple[int, LatentMoments]]:
        """Voxels and moments of the first files that can be read."""
        from slatprep.readers.slat import read_slat

        known = []
        for file in [one for one in self.files.values() if not one.problem][:_ASKED]:
            with suppress(InputError, StoreError):
                latents = read_slat(file.path, file.root, file.group, self.space)
                known.append((len(latents.coords), latents.moments))
        return known

    def _latents(self, asset_id: str) -> StructuredLatents:
        from slatprep.readers.slat import checked_latents, read_slat

        if self.store is None:
            file = self.files[asset_id]
            if file.problem:
                raise InputError(file.path, file.problem, "one SLAT an id")
            return self._of_file(read_slat(file.path, file.root, file.group, self.space))
        rows = self.store.read(asset_id, ("coords", "feats"))
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


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """TRELLIS's model, and where it runs.

    Attributes
    ----------
    model
        Repository of the model, or its folder.
    revision : COMMIT
        Revision of the model. [default: newest]
    device
        Where to run it. [default: the GPU if there is one]
    """

    model: str = "microsoft/TRELLIS-image-large"
    revision: str | None = None
    device: str | None = None

    def load(self, output: Output) -> Session:
        """Load the model, and say on which device if none was asked for."""
        from slatprep.extract import load_session

        session = load_session(self.model, self.revision, self.device)
        if self.device is None:
            output.note(f"TRELLIS runs on {session.device}")
        return session


@command("extract-slat")
def extract_slat(
    output: Output,
    images: tuple[File, ...],
    *,
    out: NewFolder,
    seeds: Annotated[tuple[int, ...], Whole(min=0), Click("--seed")] = (42,),
    by_folder: bool = False,
    model: ModelOptions,
    no_preprocess: bool = False,
) -> None:
    """Turn IMAGES into structured latents with TRELLIS's image pipeline.

    Every image and seed gives <id>.npz, or <id>/<view>.npz if there are
    views, in the form that build-store reads, and a JSON beside it with
    image, seed, model and revision. Existing files are kept, so that a stopped
    run can be continued. TRELLIS itself must be installed.

    Parameters
    ----------
    out
        Folder of the latents, which build-store takes as --slat.
    seeds
        Seed of the sampling; may be repeated, each seed gives a view.
    by_folder
        Images are named <id>/<view>, not <id>.
    no_preprocess
        The background is removed already, and the images are cropped.

    Example
    -------
    slatprep extract-slat renders/*.png --out slat
    slatprep extract-slat renders/*/*.png --by-folder --out slat --seed 0 --seed 1
    """
    from slatprep import extract as work

    extractions = work.list_extractions(images, out, seeds, by_folder)
    session = model.load(output)
    counts = {"extracted": 0, "kept": 0, "failed": 0, "voxels": 0}
    problems = []
    with output.progress("extract-slat") as progress:
        results = work.extract(session, extractions, preprocess=not no_preprocess)
        for number, result in enumerate(results, 1):
            if isinstance(result, InputError):
                counts["failed"] += 1
                problems.append(str(result))
                output.problem(f"slatprep: {result}")
            else:
                counts["kept" if result.kept else "extracted"] += 1
                counts["voxels"] += result.voxels
            progress(number, len(extractions))
    told = {"path": out, "model": session.model, "problems": problems}
    output.counted(f"Latents in {out}", counts, complete=not problems, **told)


@command("decode-slat")
def decode_slat(
    output: Output,
    source: FileOrUrl,
    *,
    out: NewFolder,
    assets: AssetIds = (),
    standardised: Standardised = "auto",
    model: ModelOptions,
) -> None:
    """Decode the structured latents of SOURCE to Gaussians with TRELLIS's decoder.

    SOURCE is a SLAT (npz or HDF5), a folder of them, or a store. Each asset
    gives <id>.ply, as TRELLIS saves Gaussians, to which `slatprep transfer`
    gives materials. TRELLIS itself must be installed.

    Parameters
    ----------
    out
        Folder of the Gaussians; files of other assets are kept.
    assets
        Decode only this asset; may be repeated.

    Example
    -------
    slatprep decode-slat slat/cup.npz --out gaussians
    slatprep decode-slat data/demo.zarr --asset 5f61cc --out gaussians
    """
    from slatprep import extract as work
    from slatprep.records import TRELLIS
    from slatprep.storage.files import file_name

    read = LatentsReader(output, source, assets, TRELLIS, standardised)
    session = model.load(output)
    begin, decoded = time.perf_counter(), 0
    with output.progress("decode-slat") as progress:
        for latents in read:
            path = out / f"{file_name(read.done[-1])}.ply"
            try:
                work.decode_gaussians(session, latents, path)
                decoded += 1
            except InputError as error:
                read.leave_out(error)
            progress(decoded + len(read.problems), len(read.ids))
    counts = {"decoded": decoded, "failed": len(read.problems)}
    told = {"path": out, "model": session.model, "problems": read.problems}
    seconds = time.perf_counter() - begin
    output.counted(
        f"Gaussians in {out}", counts, complete=not read.problems, seconds=seconds, **told
    )
