"""Make commands from functions, whose signatures declare each argument and option once.

A positional parameter is an argument of the command; a keyword-only parameter is an option. Its
entry under ``Parameters`` in the docstring is its help, with its metavar after a colon. An
annotation ``Annotated[type, ...]`` can add a `click.ParamType`, if the type alone does not define
the allowed values, and a `Click` with other settings. A type that several commands share has its
help in the annotation, as a string.

A parameter without a default is required, a ``bool`` is a flag, a ``tuple[X, ...]`` may be
repeated, a ``Literal`` is a choice. A dataclass is a group of options, which several commands may
share; its ``Attributes`` section has their help.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
import re
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from textwrap import indent
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import click

from slatprep.cli.output import OUTPUT_OPTIONS, Output, PrintingCommand, local_path
from slatprep.storage.place import is_place, storage_of

_Function = TypeVar("_Function", bound=Callable[..., object])

_SECTION = re.compile(r"^(\w[\w ]*)\n-+\n", re.M)
_ENTRY = re.compile(r"^(\w+)(?: : (.+))?\n((?: +.+\n?)+)", re.M)

_PLAIN = (int, float, str)


class Click:
    """Settings of click besides type, default and help; `flag` if it differs from the name."""

    def __init__(self, flag: str | None = None, **settings: Any) -> None:
        self.flag = flag
        self.settings = settings


def command(name: str | None = None, **settings: Any) -> Callable[[_Function], click.Command]:
    """Make a command from a function, whose docstring is the help.

    Other sections of the docstring, such as ``Example``, are printed below the options. The
    function gets an `Output` as its first argument.
    """

    def declare(function: _Function) -> click.Command:
        text, sections = _taken_from_docstring(function)
        entries = _entries(sections.pop("Parameters", ""))
        below = [f"\b\n{title}:\n{indent(body, '  ')}" for title, body in sections.items()]
        made = click.command(
            name, PrintingCommand, help=text, epilog="\n\n".join(below), **settings
        )(_runner(function))
        # The first parameter is the `Output`.
        declared = list(inspect.signature(function).parameters.values())[1:]
        made.params = [*_parameters(declared, _hints(function), entries), *OUTPUT_OPTIONS]
        return made

    return declare


def _taken_from_docstring(documented: Any) -> tuple[str, dict[str, str]]:
    """Return the text of a docstring, and its sections by their titles."""
    text, *sections = _SECTION.split(inspect.getdoc(documented) or "")
    return text, dict(zip(sections[::2], sections[1::2], strict=True))


def _entries(section: str) -> dict[str, tuple[str, str]]:
    """Return the metavar and the help of each name in a section."""
    return {name: (metavar, text) for name, metavar, text in _ENTRY.findall(section)}


def _runner(function: _Function) -> Callable[..., object]:
    """Return the function that click calls, which adds the `Output` and groups of options."""

    @functools.wraps(function)
    def run(*, as_json: bool, quiet: bool, verbose: bool, **options: Any) -> object:
        # The name has no program before it: "info", not "slatprep info".
        context = click.get_current_context()
        name = context.command_path.partition(" ")[2] or context.info_name or ""
        output = Output(as_json, int(verbose) - int(quiet), name)
        context.find_root().obj = output
        with output.failing():
            given = {name: local_path(value) for name, value in options.items()}
            require_apart(context.command, given)
            _group(_hints(function), given)
            output.store = given.get("store")
            return function(output, **given)

    return run


def _hints(declaring: Any) -> dict[str, Any]:
    return get_type_hints(declaring, include_extras=True)


def _group(hints: dict[str, Any], given: dict[str, Any]) -> None:
    """Replace the values of each group in `given` by an instance of the group."""
    for name, hint in hints.items():
        if dataclasses.is_dataclass(hint):
            _group(_hints(hint), given)
            names = [field.name for field in dataclasses.fields(hint)]
            given[name] = hint(**{name: given.pop(name) for name in names})  # type: ignore[operator]


def _parameters(
    declared: list[inspect.Parameter], hints: dict[str, Any], entries: dict[str, tuple[str, str]]
) -> Iterator[click.Argument | click.Option]:
    if unknown := entries.keys() - {parameter.name for parameter in declared}:
        raise TypeError(f"{', '.join(unknown)}: help for what is no parameter")
    for parameter in declared:
        hint = hints[parameter.name]
        if dataclasses.is_dataclass(hint):
            fields = list(inspect.signature(hint).parameters.values())  # type: ignore[arg-type]
            section = _taken_from_docstring(hint)[1].get("Attributes", "")
            yield from _parameters(fields, _hints(hint), _entries(section))
        else:
            yield _declared(parameter, hint, *entries.get(parameter.name, ("", "")))


def _declared(
    parameter: inspect.Parameter, hint: Any, metavar: str, text: str
) -> click.Argument | click.Option:
    kind, repeated, told = _taken_apart(hint)
    settings: dict[str, Any] = {"required": parameter.default is parameter.empty}
    if parameter.default not in (parameter.empty, None, ()):
        settings["default"] = parameter.default
        if parameter.default == "":
            settings["show_default"] = False
    flag = f"--{parameter.name.replace('_', '-')}"
    for entry in told:
        if isinstance(entry, str):
            text = text or entry
        elif isinstance(entry, click.ParamType):
            kind = entry
        elif isinstance(entry, Click):
            settings |= entry.settings
            flag = entry.flag or flag
        else:
            raise TypeError(f"{parameter.name}: {entry!r} says nothing to the command line")
    text = " ".join(text.split()).replace(" [default:", "  [default:")
    if metavar:
        settings["metavar"] = metavar
    if get_origin(kind) is Literal:
        kind = click.Choice(get_args(kind))
    if not (isinstance(kind, click.ParamType) or kind in (bool, *_PLAIN)):
        raise TypeError(f"{parameter.name}: {kind!r} needs a click.ParamType")
    if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
        settings |= {"nargs": -1} if repeated else {}
        return click.Argument([parameter.name], type=kind, **settings)
    if not text:
        raise TypeError(f"{parameter.name}: an option without help")
    if kind is bool:
        settings |= {"is_flag": True}
    elif repeated:
        settings |= {"multiple": True}
    kind = None if kind is bool else kind
    return click.Option([flag, parameter.name], type=kind, help=text, **settings)


def _taken_apart(hint: Any) -> tuple[Any, bool, tuple[Any, ...]]:
    """Return an annotation's type, whether it may be repeated, and the extras of `Annotated`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        kind, repeated, told = _taken_apart(arguments[0])
        return kind, repeated, (*told, *arguments[1:])
    if origin in (Union, types.UnionType):
        (only,) = (one for one in arguments if one is not types.NoneType)
        return _taken_apart(only)
    if origin is tuple:
        kind, _, told = _taken_apart(arguments[0])
        return kind, True, told
    return hint, False, ()


class SomePath(click.Path):
    """A path, which must not be empty: that would be the working folder.

    If it must exist and does not, the message names what is there.
    """

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> Any:
        """Return the value as a path."""
        if value == "":
            self.fail("is empty; expected a path", parameter, context)
        # False also where it may not be looked at, unlike `Path.exists`.
        if self.exists and not os.path.exists(value):  # noqa: PTH110
            from slatprep.storage.place import storage_of

            fault = storage_of(Path(value)).absent(files=self.file_okay, folders=self.dir_okay)
            self.fail(click.format_filename(f"{value} {fault}"), parameter, context)
        return super().convert(value, parameter, context)


class NewPath(SomePath):
    """A path of the local disk that a command writes; `require_apart` checks it."""


def require_apart(command: click.Command, given: Mapping[str, Any]) -> None:
    """Refuse to write a file or folder that is part of a store or of a command's inputs.

    A command writes the parameters of the type `NewPath`; `given` are all values by name. A new
    file or folder may lie below an input folder. An existing folder may lie below the folder of a
    run (``checkpoint``), because it holds predictions.
    """
    written = {
        parameter.name: (parameter, Path(given[parameter.name]))
        for parameter in command.params
        if isinstance(parameter.type, NewPath)
        and given.get(str(parameter.name)) is not None
        # Where the option allows it, the word none is no path.
        and not (str(parameter.metavar).endswith("|none") and given[parameter.name] == Path("none"))
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
    """Yield option name and path of each input file and folder, and of the records of stores."""
    from slatprep.store.reader import is_store
    from slatprep.store.records import manifests_of

    for name, value in given.items():
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, str):
                # The value may be a word, a file of ranges or ids, or [NAME=]DIR. Elsewhere than
                # in --grids a word like "train" may also name a folder.
                path = one.rpartition("=")[2]
                exists = os.path.exists if name == "grids" else os.path.isfile
                if exists(path):  # A word too long for a name is no error.
                    yield name, Path(path)
            elif is_place(one) and (local := storage_of(one).local) is not None:
                yield name, local
                if is_store(local):
                    yield name, Path(str(manifests_of(local)))
