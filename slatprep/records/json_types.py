"""Types of values as JSON holds them, with the bounds that a reader checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

MAX_SHEAR = 1e-6
"""Largest deviation of a similarity's rotation from an orthogonal matrix, by entry."""

_MAX_SIDE = 32
_FINITE = {"type": "float", "allow_inf_nan": False}


@dataclass(frozen=True, eq=False)
class InJson:
    """How pydantic reads an annotated field: by a core schema, and a function on its result."""

    schema: Any
    then: Any = None

    def __get_pydantic_core_schema__(self, source: object, handler: object) -> Any:
        """Return the schema; see pydantic's documentation of custom types."""
        if self.then is None:
            return self.schema
        function = {"type": "no-info", "function": self.then}
        return {"type": "function-after", "function": function, "schema": self.schema}


def _array(*shape: int | None) -> InJson:
    schema: dict[str, Any] = dict(_FINITE)
    for size in reversed(shape):
        length = {"min_length": size or 0, "max_length": _MAX_SIDE if size is None else size}
        schema = {"type": "list", "items_schema": schema} | length

    def array(values: list[Any]) -> NDArray[np.float64]:
        made = np.array(values, dtype=np.float64)
        if made.ndim < len(shape) and made.size == 0:
            made = made.reshape([size or 0 for size in shape])
        if made.ndim != len(shape):
            raise ValueError("rows of different lengths")
        return made

    return InJson(schema, array)


_MATRIX = _array(4, 4)


def _similarity(values: list[Any]) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = _MATRIX.then(values)
    if (matrix[3] != (0, 0, 0, 1)).any() or not 1e-9 < np.linalg.det(matrix[:3, :3]) < 1e9:
        raise ValueError("no map of the frames: it has no inverse, or mirrors")
    turned = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
    if np.abs(turned @ turned.T - np.eye(3)).max() > MAX_SHEAR:
        raise ValueError("no similarity: it shears, or scales one axis more than another")
    return matrix


def one_of(*values: object) -> InJson:
    """Return how to read a field that is one of several values."""
    return InJson({"type": "literal", "expected": list(values)})


def _null_is_nan(value: float | None) -> float:
    return float("nan") if value is None else value


Share = Annotated[float, Ge(0), Le(1)]
"""A share, 0 to 1."""

Count = Annotated[int, Ge(0), Le(2**53)]
"""A count, 0 to the largest whole number that every reader of JSON keeps."""

Number = Annotated[float, InJson({"type": "nullable", "schema": _FINITE}, _null_is_nan)]
"""A number that may be NaN, which is null in JSON."""

Digest = Annotated[str, InJson({"type": "str", "pattern": "^[0-9a-f]{64}$"})]
"""SHA-256 in hex."""

Transform = Annotated[NDArray[np.float64], InJson(_MATRIX.schema, _similarity)]
"""Homogeneous, (4, 4): PixieVerse frame to SLAT frame, a similarity."""

Rotation = Annotated[NDArray[np.float64], _array(3, 3)]
"""(3, 3), orthogonal."""

AffineMap = Annotated[NDArray[np.float64], _array(3, 4)]
"""(3, 4): x -> A x + b."""

Point = Annotated[NDArray[np.float64], _array(3)]
"""(3,), edges of the unit cube."""

Lattice = Annotated[NDArray[np.float64], _array(None, None, None, 3)]
"""(n0, n1, n2, 3): a vector at each point of a lattice of at most 32 points a side."""
