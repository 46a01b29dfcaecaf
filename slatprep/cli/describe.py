"""`slatprep describe`: a store in Croissant, for catalogues of datasets."""

from __future__ import annotations

import os
from pathlib import Path

from slatprep.cli.options import FolderOrUrl, NewFile, StatedOptions
from slatprep.cli.output import Output, say
from slatprep.cli.signature import command
from slatprep.storage.place import storage_of

_ASKED_FOR = ("license", "cite_as", "date_published")
"""Optional metadata whose absence Croissant's validator warns of."""


@command(context_settings={"show_default": False})
def describe(
    output: Output,
    store: FolderOrUrl,
    *,
    out: NewFile | None = None,
    location: str = "",
    stated: StatedOptions,
) -> None:
    """Describe STORE in Croissant, MLCommons' vocabulary for datasets.

    The description is JSON-LD: the files of every array, their shapes and
    meaning, the classes, the ranges of the properties, and the table of
    assets. Catalogues of datasets and the mlcroissant package read it.

    Parameters
    ----------
    out : FILE.json
        The file. [default: standard output]
    location : URL
        Where its readers will find the store. [default: its path, as seen from the description]

    Example
    -------
    slatprep describe data/demo.zarr
    slatprep describe data/demo.zarr --out demo.croissant.json --name demo
    """
    from slatprep.export import croissant
    from slatprep.storage.atomic import staged, writing
    from slatprep.store import open_store

    if not location:
        local, beside = storage_of(store).local, out.parent if out else Path()
        location = Path(os.path.relpath(local, beside)).as_posix() if local else str(store)
    missing = [f"--{name.replace('_', '-')}" for name in _ASKED_FOR if not getattr(stated, name)]
    if missing:
        output.note(f"catalogues also ask for {', '.join(missing)}")
    told = croissant.Stated(**vars(stated))
    document = croissant.describe(open_store(store), told, location.rstrip("/"))
    text = croissant.to_json(document)
    if out is None:
        say(text, nl=False)
        return
    with writing(str(out), out.parent), staged(out) as path:
        path.write_text(text, encoding="utf-8")
    output.note(f"description: {out}")
