"""Which rows of a new store are where they were in the old one, so that bytes can be taken over."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

Piece = tuple[bool, int, int]
"""Whether the existing store has the rows of some whole chunks, the first of them, and the end."""


@dataclass(frozen=True)
class Unmoved:
    """Rows that are the same, at the same place, in an old and a new array.

    Attributes
    ----------
    runs : tuple of (int, int)
        Their beginnings and ends, ascending; no run touches the next.
    old, new : int
        Rows of the two arrays.
    shards_alike : bool
        Whether both are cut into shards of the same size.
    """

    runs: tuple[tuple[int, int], ...]
    old: int
    new: int
    shards_alike: bool = True

    def holds_shard(self, start: int, end: int) -> bool:
        """Whether a shard, rows ``start`` to ``end - 1``, has the same bytes in both."""
        return self.shards_alike and self.holds(start, end)

    def holds(self, start: int, end: int) -> bool:
        """Whether chunks, rows ``start`` to ``end - 1``, have the same bytes in both.

        Its last rows may lie beyond the arrays: then both must end at the same row.
        """
        stop = min(end, self.new)
        position = bisect_right(self.runs, (start, self.new)) - 1
        inside = position >= 0 and self.runs[position][1] >= stop
        return inside and (end <= min(self.old, self.new) or self.old == self.new)

    def pieces(self, start: int, stop: int, chunk: int) -> Iterator[Piece]:
        """Cut the rows of a shard into pieces of whole chunks that are the same, or are not.

        Examples
        --------
        >>> list(Unmoved(((0, 5),), old=5, new=9).pieces(0, 9, 2))
        [(True, 0, 4), (False, 4, 9)]
        """
        begins = range(start, stop, chunk)
        for same, own in groupby(begins, lambda begin: self.holds(begin, begin + chunk)):
            chunks = list(own)
            yield same, chunks[0], min(chunks[-1] + chunk, stop)


def unmoved(
    spans: Iterable[tuple[int, int]], old: int, new: int, shards_alike: bool = True
) -> Unmoved:
    """Return the rows that spans cover; those that touch become one run.

    Examples
    --------
    >>> unmoved([(0, 2), (2, 5), (7, 9)], old=9, new=12).runs
    ((0, 5), (7, 9))
    """
    runs: list[tuple[int, int]] = []
    for start, stop in spans:
        if runs and runs[-1][1] == start:
            runs[-1] = (runs[-1][0], stop)
        else:
            runs.append((start, stop))
    return Unmoved(tuple(runs), old, new, shards_alike)
