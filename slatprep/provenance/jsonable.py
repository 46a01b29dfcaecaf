"""Values as JSON can hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np

from slatprep.storage.place import is_place


def jsonable(value: object) -> Any:
    """Return a value as JSON can hold it: NaN and infinity become None."""
    # Most of a record are plain numbers and words: these first.
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        return jsonable(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if is_place(value):
        return str(value)
    if isinstance(value, bool | int | str):
        return value
    raise TypeError(f"a record cannot hold {type(value).__name__} {value!r}")
