"""Find rows of a new array that are adjacent in an older one, so that bytes can be taken over."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple


class Run(NamedTuple):
    """Rows ``start`` to ``stop - 1`` of a new array, which lie `shift` rows on in an older store.

    `store` is the number of the older store.
    """

    start: int
    stop: int
    store: int
    shift: int


Piece = tuple[Run | None, int, int]
"""Run, first row and end of some rows: whole chunks that the run holds, or any rows if None."""


@dataclass(frozen=True)
class Runs:
    """The runs of an array of `new` rows, ascending and without overlap.

    `old` has the number of rows of the array in each older store.
    """

    runs: tuple[Run, ...] = ()
    new: int = 0
    old: tuple[int, ...] = ()

    def holds(self, start: int, end: int) -> Run | None:
        """Return the run whose store has the chunk of rows `start` to ``end - 1`` in equal bytes.

        If the chunk reaches beyond the new array, both arrays must end at the same row of it.
        `start` and `end` may be those of a shard too.
        """
        stop = min(end, self.new)
        position = bisect_right(self.runs, start, key=lambda run: run.start) - 1
        run = self.runs[position] if position >= 0 else None
        if run is None or run.stop < stop or run.shift % (end - start):
            return None
        old = self.old[run.store]
        whole = end <= self.new and end + run.shift <= old
        return run if whole or (stop == self.new and stop + run.shift == old) else None

    def pieces(self, start: int, stop: int, chunk: int) -> Iterator[Piece]:
        """Cut the rows of a shard into pieces: whole chunks that a run holds, and other rows.

        >>> list(Runs((Run(0, 5, 0, 0),), new=9, old=(5,)).pieces(0, 9, 2))
        [(Run(start=0, stop=5, store=0, shift=0), 0, 4), (None, 4, 9)]
        """
        begins = range(start, stop, chunk)
        for run, own in groupby(begins, lambda begin: self.holds(begin, begin + chunk)):
            chunks = list(own)
            yield run, chunks[0], min(chunks[-1] + chunk, stop)


def runs_of(spans: Iterable[Run], new: int, old: tuple[int, ...]) -> Runs:
    """Join spans that continue one another into runs.

    >>> runs_of([Run(0, 2, 0, 5), Run(2, 5, 0, 5), Run(7, 9, 0, 5)], 12, (20,)).runs
    (Run(start=0, stop=5, store=0, shift=5), Run(start=7, stop=9, store=0, shift=5))
    """
    runs: list[Run] = []
    for span in spans:
        last = runs[-1] if runs else None
        if last and (last.stop, *last[2:]) == (span.start, *span[2:]):
            runs[-1] = Run(last.start, *span[1:])
        elif span.start < span.stop:
            runs.append(span)
    return Runs(tuple(runs), new, old)
