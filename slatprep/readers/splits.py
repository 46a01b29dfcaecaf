"""Split objects into training, validation and test, by a hash, a rule, or lists of ids."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import CATEGORY, NAMED_SPLITS
from slatprep.readers.files import ArraySpec, is_text, npy_array, refusing
from slatprep.records import Place
from slatprep.storage.documents import parse_json, read_bounded, unique
from slatprep.storage.place import place_of

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class Shares:
    """Expected shares of the objects in each split; ConfigError unless they add up to 1."""

    train: float = 0.8
    val: float = 0.1
    test: float = 0.1

    def __post_init__(self) -> None:
        values = (self.train, self.val, self.test)
        if not (min(values) >= 0 and abs(sum(values) - 1) <= 1e-9):  # NaN fails both
            raise ConfigError(
                f"shares of train, val and test are {values}; "
                "expected three numbers from 0 to 1 that add up to 1, such as 0.8, 0.1, 0.1"
            )


def position_of(object_id: str) -> float:
    """Return an object's position in [0, 1): the first 8 bytes of its id's SHA-256, over 2^64."""
    digest = hashlib.sha256(object_id.encode("utf-8")).digest()
    # A float64 holds 53 bits exactly, so the result never rounds up to 1.
    return (int.from_bytes(digest[:8], "big") >> 11) / 2**53


def split_of(object_id: str, shares: Shares = Shares()) -> Split:
    """Return the split of an object, by its id alone.

    The id is ``asset/object_id`` of the store, so that all views of an object share a split. An
    object stays in its split when the dataset grows.
    """
    position = position_of(object_id)
    if position < shares.train:
        return "train"
    return "val" if position < shares.train + shares.val else "test"


def split_objects(object_ids: Iterable[str], shares: Shares = Shares()) -> dict[str, Split]:
    """Return the split of every object of a dataset, so that no split with a share is empty.

    `split_of` decides. A split that would be empty takes the object nearest to its middle in [0, 1)
    from a split that has several. This needs at least as many objects as splits.
    It moves back once the dataset has grown and others fill the split.
    Training and test must pass the same `object_ids`: all of the dataset, before any filter.
    """
    splits = {object_id: split_of(object_id, shares) for object_id in sorted(set(object_ids))}
    ends = {"train": 0.0, "val": shares.train, "test": shares.train + shares.val}
    for split in SPLITS:
        share, low = getattr(shares, split), ends[split]
        if share == 0 or split in splits.values():
            continue
        counts = Counter(splits.values())
        if spare := [object_id for object_id, other in splits.items() if counts[other] > 1]:
            middle = low + share / 2
            splits[min(spare, key=lambda object_id: abs(position_of(object_id) - middle))] = split
    return splits


HASH, PIXIE = NAMED_SPLITS

_MAX_BYTES = 64 * 2**20
_IDS = ArraySpec(((None,),), "US")
_FORMS = (
    "a file of ids: one a line, a JSON list of them, a JSON object of the lists train, val and "
    "test, or an npy array of text"
)


@dataclass(frozen=True)
class Assignment:
    """Split of each object of a dataset, by its id.

    If a file of lists decides, `unknown` are listed ids that the dataset lacks. `unlisted` are the
    objects that no list names; they are in no split.
    """

    splits: dict[str, Split]
    unknown: tuple[str, ...] = ()
    unlisted: tuple[str, ...] = ()

    def lists(self) -> dict[Split, list[str]]:
        """Return the objects of each split, sorted, in the form that `read_lists` reads."""
        ids = sorted(self.splits)
        return {split: [one for one in ids if self.splits[one] == split] for split in SPLITS}


def assign_splits(
    by: str | Place,
    objects: Mapping[str, str],
    shares: Shares = Shares(),
    assets: Mapping[str, str] | None = None,
) -> Assignment:
    """Return the split of every object of a dataset by a rule; `objects` maps ids to categories.

    The rule `by` is ``hash`` (see `split_objects`), ``pixie`` (see `pixie_test_objects`),
    ``category:NAME`` (that category is the test set), or the path of a file (see `read_lists`).
    `shares` apply to ``hash``. If a rule gives only the test set, a hash splits the others in the
    shares' proportion of train and val. `assets` maps asset ids, by which a file may name objects,
    to object ids. ConfigError if the category is unknown or a file puts an object into two splits;
    InputError if the file is unusable or names no object of the dataset.
    """
    if by == HASH:
        return Assignment(split_objects(objects, shares))
    if by == PIXIE:
        return Assignment(_around(pixie_test_objects(objects), objects, shares))
    if isinstance(by, str) and by.startswith(CATEGORY):  # A path is no word for a rule.
        name = by.removeprefix(CATEGORY)
        chosen = [object_id for object_id, category in objects.items() if category == name]
        if not chosen:
            known = ", ".join(sorted(set(objects.values()) - {""})) or "none"
            raise ConfigError(f"no object has the category {name!r}; expected one of: {known}")
        return Assignment(_around(chosen, objects, shares))
    return _by_file(place_of(by), objects, shares, assets or {})


def pixie_test_objects(object_ids: Iterable[str]) -> list[str]:
    """Return the objects that Pixie's rule sets aside for its test: a tenth, drawn with seed 42.

    Pixie splits n objects by ``torch.utils.data.random_split`` with a generator of seed 42 into
    ``int(0.9 * n)`` and the rest, and tests on the rest (vlongle/pixie,
    ``training_discrete.py``). It takes objects in the order of its file system; here they are
    sorted. The objects that Pixie itself tested on are in its ``test_set.json``.
    """
    ordered = sorted(set(object_ids))
    # torch.randperm swaps each place with a place drawn from those not yet filled. It draws a
    # 32-bit word of MT19937, seeded as numpy's legacy generator is, modulo their number.
    words = np.random.RandomState(42)
    for place in range(len(ordered) - 1):
        other = place + int(words.randint(0, 2**32, dtype=np.uint32)) % (len(ordered) - place)
        ordered[place], ordered[other] = ordered[other], ordered[place]
    return ordered[int(0.9 * len(ordered)) :]


def read_lists(path: Place) -> dict[Split, tuple[str, ...]]:
    """Read the ids of each split, of objects or assets.

    The file is a JSON object with some of the lists ``train``, ``val`` and ``test``. It may also be
    a test list alone, as JSON, a one-dimensional npy of text, or an id per line. InputError
    otherwise.
    """
    data = read_id_file(path)
    with refusing(path, "cannot be read", _FORMS):
        if path.suffix == ".npy":
            names = npy_array(data, path, _IDS).astype(str)
            if not is_text(names):
                raise ValueError("it holds no text")
            listed: Any = names.tolist()
        elif path.suffix == ".json":
            listed = parse_json(data)
            json.loads(data, object_pairs_hook=unique)  # parse_json takes the last of two keys.
        else:
            lines = map(str.strip, data.decode("utf-8-sig").splitlines())
            listed = [line for line in lines if line]
    lists = listed if isinstance(listed, dict) else {"test": listed}
    for name, ids in lists.items():
        if name not in SPLITS:
            raise InputError(path, f"has a list {name[:80]!r}", f"some of {', '.join(SPLITS)}")
        if not isinstance(ids, list):
            raise InputError(path, f"holds {type(ids).__name__} for {name}", _FORMS)
        if wrong := [one for one in ids if not isinstance(one, str)]:
            raise InputError(path, f"{name} has {str(wrong[0])[:80]!r}, which is no text", _FORMS)
    if not any(lists.values()):
        raise InputError(path, "has no id", _FORMS)
    return {split: tuple(lists[split]) for split in SPLITS if split in lists}


def read_id_file(path: Place) -> bytes:
    """Read a whole file of ids; InputError if that fails."""
    try:
        return read_bounded(path, _MAX_BYTES)
    except FileNotFoundError:
        rules = f"{HASH}, {PIXIE}, {CATEGORY}NAME, or {_FORMS}"
        raise InputError(path, "does not exist", rules) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(path, f"cannot be read ({reason})", _FORMS) from None


def _by_file(
    path: Place, objects: Mapping[str, str], shares: Shares, assets: Mapping[str, str]
) -> Assignment:
    lists = read_lists(path)
    splits: dict[str, Split] = {}
    unknown: dict[str, None] = {}
    for split, ids in lists.items():
        for one in ids:
            object_id = one if one in objects else assets.get(one)
            if object_id is None:
                unknown[one] = None
            elif splits.setdefault(object_id, split) != split:
                raise ConfigError(
                    f"{path}: {one!r} is in the lists {splits[object_id]} and {split}; expected "
                    "every object, with all its views, in one"
                )
    if not splits:
        example = min(objects, default="none: there is no object")
        fault = f"has none of the dataset's {len(objects):,} objects"
        raise InputError(path, fault, f"ids such as {example}")
    if lists.keys() == {"test"}:
        splits = _around(splits, objects, shares)
    unlisted = tuple(object_id for object_id in sorted(objects) if object_id not in splits)
    return Assignment(splits, tuple(unknown), unlisted)


def _around(test: Iterable[str], objects: Iterable[str], shares: Shares) -> dict[str, Split]:
    """Return the split of each object for a given test set; a hash splits the other objects."""
    splits: dict[str, Split] = dict.fromkeys(test, "test")
    others = shares.train + shares.val
    if others == 0:
        raise ConfigError(
            "shares leave nothing to train and validate on; expected a share of train, such as "
            "0.9,0.1,0"
        )
    train = shares.train / others
    rest = (object_id for object_id in objects if object_id not in splits)
    return splits | split_objects(rest, Shares(train, 1 - train, 0.0))
