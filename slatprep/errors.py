"""The errors slatprep raises on purpose: what is wrong, what is allowed, what to do."""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager


def in_unicode(text: str) -> str:
    r"""Return a text with escapes for all characters that UTF-8 cannot encode.

    File names are bytes. Python represents bytes that are not UTF-8 as lone surrogates, which no
    record, store or terminal accepts.

    >>> print(in_unicode("a\udcff.npz"))
    a\udcff.npz
    """
    return text.encode(errors="backslashreplace").decode()


def printable(text: str) -> str:
    r"""Return text with control characters written as JSON escapes.

    Names and categories are not trusted. Line breaks, tabs, spaces of any width, joiners and
    non-joiners are kept.

    >>> print(printable("cup" + chr(27) + "[2J"))
    cup\u001b[2J
    """
    if text.isprintable():
        return text
    return "".join(c if _is_harmless(c) else _escaped(c) for c in text)


def _is_harmless(c: str) -> bool:
    return c.isprintable() or c in "\n\t\u200c\u200d" or unicodedata.category(c) == "Zs"


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else json.dumps(character)[1:-1]


def apart_from(name: str, others: Collection[str]) -> str:
    """Return the name of a table's row, in quotes if another row has the same name.

    >>> apart_from("cup", ("all",)), apart_from("all", ("all",))
    ('cup', '"all"')
    """
    return f'"{name}"' if name in others else name


UNKNOWN = "(unknown)"
"""Name of the row of assets without a category."""


def row_of_category(name: str) -> str:
    """Return the name of a category's row in a table that also has a row for all assets."""
    return apart_from(name, (UNKNOWN, "all")) or UNKNOWN


def amount(count: int, noun: str) -> str:
    """Return a count and its noun, in the singular or the plural.

    >>> amount(1, "voxel"), amount(2000, "voxel"), amount(0, "asset")
    ('1 voxel', '2,000 voxels', '0 assets')
    """
    return f"{count:,} {noun if count == 1 else noun + 's'}"


def first_of(names: Iterable[str], most: int = 3, number: int | None = None) -> str:
    """Return the first names, and how many there are beside them; `number` is that of all.

    >>> first_of(["cup", "ant", "fox"], 2)
    'cup, ant and 1 more'
    >>> first_of(["cup", "ant"], 2)
    'cup, ant'
    >>> first_of(["cup", "ant"], 2, number=9)
    'cup, ant and 7 more'
    """
    names = list(names)
    more = (len(names) if number is None else number) - most
    return ", ".join(names[:most]) + (f" and {more:,} more" if more > 0 else "")


def tally(words: Iterable[object]) -> str:
    """Return how often each word occurs.

    >>> tally(["good", "failed", "good"])
    '1 failed, 2 good'
    """
    counts = sorted(Counter(map(str, words)).items())
    return ", ".join(f"{count:,} {word}" for word, count in counts)


def require_one_of(name: str, value: object, allowed: Iterable[str]) -> None:
    """Raise ConfigError if a parameter's value is not one of the allowed words."""
    if value not in (words := tuple(allowed)):
        raise ConfigError(f"{name} is {value!r}; expected one of {', '.join(words)}")


class SlatprepError(Exception):
    """Base of every error that slatprep raises on purpose."""

    def __init__(self, message: str = "") -> None:
        super().__init__(in_unicode(message))


class InputError(SlatprepError):
    """A source file that cannot be used.

    Parameters
    ----------
    path : str or Place
        The file (or dataset inside a file) at fault.
    fault : str
        What is wrong with it, with the value at fault.
    expected : str
        What is allowed, or what to do.
    """

    def __init__(self, path: object, fault: str, expected: str) -> None:
        super().__init__(f"{path}: {fault}; expected {expected}")
        self.path = in_unicode(str(path))
        self.fault = in_unicode(fault)
        self.expected = expected

    def below(self, root: object) -> str:
        """Return the message on one line as records have it, with paths relative to a root.

        A dataset may move, while its records stay.
        """
        path = rf"(?<![^\s'\"(]){re.escape(in_unicode(str(root)))}/"
        return " ".join(re.sub(path, "", str(self)).split())

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        # Pickle needs this to send an exception with its own signature from a worker
        # process to the parent.
        return (type(self), (self.path, self.fault, self.expected))


class MissingPartnerError(InputError):
    """One side of a pair (PixieVerse field or SLAT) does not exist."""


class ConfigError(SlatprepError):
    """A dataset definition or option that makes no sense."""


class StoreError(SlatprepError):
    """A store that cannot be read, written or trusted."""


class UnknownAssetError(StoreError, ConfigError):
    """A name that matches no asset of a store, or several: the caller's mistake."""


@contextmanager
def needing(what: str, extra: str) -> Iterator[None]:
    """Raise a ConfigError that says how to install a package if its import in the block fails."""
    try:
        yield
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        package = f"the package {error.name}" if missing else f"a package that fails ({error})"
        way = f"install it with `pip install 'slatprep[{extra}]'`"
        raise ConfigError(f"{what} {package}; {way}") from error
