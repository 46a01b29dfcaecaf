"""Check that each room of the package keeps its budget of code lines, listed in CONTRIBUTING.md.

    python tools/budget.py

A code line is a line that is neither blank, comment nor docstring. A room over its budget fails;
a change that needs more lines also raises the number.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from pathlib import Path

TOP = Path(__file__).parents[1]
_ENTRY = re.compile(r"^\| `slatprep/([\w.]*)/?` \| ([\d,]+) \|", re.MULTILINE)
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
            tokenize.ENCODING, tokenize.ENDMARKER}  # fmt: skip


def code_lines(text: str) -> int:
    """Return the number of code lines of a module."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for entry in body if isinstance(body, list) else []:
            # These include the strings that describe a field or a constant.
            if isinstance(entry, ast.Expr) and isinstance(entry.value, ast.Constant):
                docstrings |= set(range(entry.lineno, (entry.end_lineno or 0) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - docstrings)


def rooms() -> dict[str, int]:
    """Return the code lines of each room; modules at the top of the package form a room."""
    counts: dict[str, int] = {}
    for file in sorted((TOP / "slatprep").rglob("*.py")):
        folders = file.relative_to(TOP / "slatprep").parts
        room = folders[0] if len(folders) > 1 else ""
        counts[room] = counts.get(room, 0) + code_lines(file.read_text())
    return counts


def main() -> int:
    """Print each room that is over its budget or has none; return the exit code."""
    told = (TOP / "CONTRIBUTING.md").read_text()
    budgets = {room: int(number.replace(",", "")) for room, number in _ENTRY.findall(told)}
    counts, wrong = rooms(), 0
    for room in sorted({*counts, *budgets}):
        count, budget = counts.get(room, 0), budgets.get(room)
        if budget is None or count > budget or count == 0:
            wrong += 1
            allowed = "no budget" if budget is None else f"{budget:,} allowed"
            way = "make it shorter, or change its row at the end of CONTRIBUTING.md and say why"
            print(f"slatprep/{room}: {count:,} code lines, {allowed}: {way}")
    print(f"{sum(counts.values()):,} code lines in {len(counts)} rooms")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
