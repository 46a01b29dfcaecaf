"""Measure the prose of README, docs, help texts and messages: `python tools/prose.py`.

A sentence has at most 30 words, and the median sentence at most 14. Code blocks, tables, headings,
pictures and equations do not count as sentences; a piece of inline code counts as one word. The
sentences of design notes (docs/design) must keep the limit too, but their words have no budget.
"""

from __future__ import annotations

import argparse
import ast
import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST, MEDIAN = 30, 14
BUDGET = 18_900
"""Largest number of words of README and docs with their tables, without design notes and
generated pages."""

MADE = {"benchmarks.md"}
ENDS = r"(?:(?<=[.!?:;])|(?<=[.!?:;]\*\*))\s+(?=(?:\*\*)?[A-Z])"
"""Pattern of the space between two sentences, also beside bold text."""


def sentences_of(text: str) -> Iterator[str]:
    """Yield the sentences of a Markdown text, with inline code as one word."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$", "", text, flags=re.S)
    lines = (line for line in text.splitlines() if not line.startswith(("|", "#", "!", "<")))
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", "\n".join(lines))
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "X", text)
    for paragraph in re.split(r"\n\s*\n|\n\s*(?:-|\d+\.) ", text):
        yield from re.split(ENDS, " ".join(paragraph.split()))


def words_of(text: str) -> list[str]:
    """Return the words of a text; a word has a letter or a digit, unlike the bars of a table."""
    return [word for word in text.split() if re.search(r"\w", word)]


def pages() -> dict[str, str]:
    """Return the text of each page, by its path."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}


def messages() -> Iterator[tuple[str, str]]:
    """Yield the package's texts for users: help texts, error messages and printed lines."""
    for path in sorted((ROOT / "slatprep").rglob("*.py")):
        place = path.relative_to(ROOT).as_posix()
        tree = ast.parse(path.read_text("utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and place.startswith(
                "slatprep/cli/"
            ):
                # Examples and the names of options in the sections below are not sentences.
                text, *sections = re.split(r"\n(\w[\w ]*)\n-+\n", ast.get_docstring(node) or "")
                helps = dict(zip(sections[::2], sections[1::2], strict=True))
                entries = helps.get("Parameters", helps.get("Attributes", ""))
                yield f"{place}:{node.lineno}", text
                for entry in re.split(r"^\w.*$|(?=\[default)", entries, flags=re.M):
                    yield f"{place}:{node.lineno}", entry
            if isinstance(node, ast.JoinedStr):
                parts = [p.value if isinstance(p, ast.Constant) else "X" for p in node.values]
                yield f"{place}:{node.lineno}", "".join(map(str, parts))
            if isinstance(node, ast.Call):
                for argument in [*node.args, *(word.value for word in node.keywords)]:
                    if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                        yield f"{place}:{argument.lineno}", argument.value


def main() -> None:
    """Print findings and counts; exit with 1 if there are findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--all", action="store_true", help="print a line for each page")
    everything = parser.parse_args().all
    lengths: list[int] = []
    words = 0
    faults: list[str] = []
    for place, text in pages().items():
        own = [len(sentence.split()) for sentence in sentences_of(text) if sentence]
        made, design = Path(place).name in MADE, "design" in Path(place).parts
        if everything:
            longest = sum(length > LONGEST for length in own)
            print(f"{len(words_of(text)):6} words, {longest:3} long sentences  {place}")
        if not made:
            faults += too_long(place, text)
        if not made and not design:
            words += len(words_of(text))
            lengths += own
    for place, text in messages():
        faults += too_long(place, text)
    median = statistics.median(lengths)
    if median > MEDIAN:
        faults.append(f"the median sentence has {median:.0f} words; at most {MEDIAN} are allowed")
    if words > BUDGET:
        way = "make them shorter, or raise BUDGET in tools/prose.py and say why"
        faults.append(f"README and docs have {words:,} words, {BUDGET:,} are allowed: {way}")
    print("\n".join(faults), file=sys.stderr)
    print(
        f"README and docs: {words:,} words, {len(lengths):,} sentences, "
        f"median {median:.0f} words; {len(faults)} findings"
    )
    sys.exit(bool(faults))


def too_long(place: str, text: str) -> list[str]:
    """Return a line for each sentence of more than 30 words."""
    found = []
    for sentence in sentences_of(text):
        count = len(sentence.split())
        if count > LONGEST:
            start = " ".join(sentence.split()[:9])
            found.append(f"{place}: a sentence of {count} words: {start} ...")
    return found


if __name__ == "__main__":
    main()
