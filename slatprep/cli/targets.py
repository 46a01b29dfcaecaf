"""Where commands write: never into a store, nor over what they read."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from slatprep.storage.place import is_place, storage_of


class NewPath(click.Path):
    """A path of the local disk that a command writes, which `require_apart` looks at."""


def require_apart(command: click.Command, given: Mapping[str, Any]) -> None:
    """Refuse a file or folder to write that is part of a store or of what a command reads.

    A command writes the parameters of the type `NewPath`; `given` are all values by name. A new
    file or folder below a folder that is read may be written. So may a folder below that of a run,
    which holds predictions.
    """
    written = {
        parameter.name: (parameter, Path(given[parameter.name]))
        for parameter in command.params
        if isinstance(parameter.type, NewPath) and given.get(str(parameter.name)) is not None
    }
    if not written:
        return
    from slatprep.store.reader import require_outside

    read = list(_inputs({name: value for name, value in given.items() if name not in written}))
    for parameter, out in written.values():
        require_outside(out)
        target = out.resolve()
        if target.exists() and not (target.is_file() or target.is_dir()):
            raise click.BadParameter(
                f"{out} is a pipe or device; expected a file or folder", param=parameter
            )
        for name, place in read:
            inside = place.resolve() in target.parents
            taken = target.is_file() or (target.is_dir() and name != "checkpoint")
            if place.resolve() == target or (inside and taken):
                what = f"lies in {place}," if inside else "is"
                raise click.BadParameter(
                    f"{out} {what} what the command reads; expected another path", param=parameter
                )


def _inputs(given: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Yield files and folders among options, by name, and the records of stores."""
    from slatprep.store.reader import is_store
    from slatprep.store.records import manifests_of

    for name, value in given.items():
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, str):
                # A word, or a file, of ranges or of ids. Folders of grids, [NAME=]DIR, are not
                # looked at: a word like "train" may be the name of a folder that it does not mean.
                path = one.rpartition("=")[2]
                if os.path.isfile(path):  # noqa: PTH113 - a word too long for a name is no error
                    yield name, Path(path)
            elif is_place(one) and (local := storage_of(one).local) is not None:
                yield name, local
                if is_store(local):
                    yield name, Path(str(manifests_of(local)))
