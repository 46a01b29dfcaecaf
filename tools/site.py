"""Hook into the documentation site: add pages from outside docs/, fix links, list the API.

mkdocs runs these functions (``hooks`` in mkdocs.yml) when `make docs` builds the site.
"""

from __future__ import annotations

import ast
import html
import logging
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "slatprep"
NEIGHBOURS = {
    "README.md": "start.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
}
"""Pages in the repository's root, and their names on the site."""

log = logging.getLogger("mkdocs.site")  # below mkdocs: a warning fails a strict build


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the rooms of the package after the other pages."""
    pages = [{"slatprep": "api/index.md"}, *({room: f"api/{room}.md"} for room in _rooms())]
    config.nav = [*(config.nav or []), {"API": pages}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside docs/."""
    for source, name in NEIGHBOURS.items():
        text = (ROOT / source).read_text("utf-8")
        files.append(File.generated(config, name, content=_from_root(text, source)))
    files.append(File.generated(config, "api/index.md", content=_face()))
    for room in _rooms():
        files.append(File.generated(config, f"api/{room}.md", content=f"::: slatprep.{room}\n"))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Replace links out of docs/ by links to a page of the site, or by the name of a file."""
    home = (ROOT / "docs" / page.file.src_uri).parent

    def follow(match: re.Match[str]) -> str:
        text, target = match.groups()
        path, _, anchor = target.partition("#")
        there = (home / path).resolve()
        if there.is_relative_to(ROOT / "docs"):
            return match.group()
        name = there.relative_to(ROOT).as_posix()
        if name in NEIGHBOURS:
            up = "../" * page.file.src_uri.count("/")
            return f"[{text}]({up}{NEIGHBOURS[name]}{'#' + anchor if anchor else ''})"
        if not there.exists():
            log.warning("%s links to %s, which does not exist", page.file.src_uri, path)
        return text

    return re.sub(r"\[([^\]]*)\]\((\.\./[^)]+)\)", follow, markdown)


def on_page_content(content: str, **_: object) -> str:
    """Convert equations to MathML, which browsers draw themselves."""

    def draw(match: re.Match[str]) -> str:
        display, latex = match["open"] == "[", html.unescape(match["latex"])
        drawn = convert(latex, display="block" if display else "inline")
        # On a narrow screen, a long equation scrolls inside its own box.
        return f'<div style="overflow-x: auto">{drawn}</div>' if display else drawn

    opening = r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])'
    equation = opening + r"(?P<latex>.*?)\\[)\]]</(?P=tag)>"
    return re.sub(equation, draw, content, flags=re.S)


def _from_root(text: str, source: str) -> str:
    """Return a page of the root with links as if it were in docs/."""

    def move(match: re.Match[str]) -> str:
        target = match.group(1)
        return f"]({target[5:] if target.startswith('docs/') else '../' + target})"

    return re.sub(r"\]\((?!https?:|#|mailto:)([^)]+)\)", move, text)


def _rooms() -> list[str]:
    """Return the names at the top of the package, alphabetically."""
    return sorted(
        path.stem
        for path in PACKAGE.iterdir()
        if not path.name.startswith("_")
        and (path.suffix == ".py" or (path / "__init__.py").exists())
    )


def _face() -> str:
    """Return the page of names that ``import slatprep`` offers, with their summaries."""
    lines = ["# slatprep", "", ast.get_docstring(ast.parse(_source("slatprep"))) or "", ""]
    lines += ["| name | |", "| --- | --- |"]
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                home = f"slatprep.{node.module.removeprefix('slatprep.')}"
                home = _definition(home, alias.name)
                lines.append(
                    f"| [`{alias.name}`][{home}.{alias.name}] | {_summary(home, alias.name)} |"
                )
    return "\n".join(lines) + "\n"


def _source(module: str) -> str:
    path = ROOT / Path(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return file.read_text("utf-8")


def _definition(module: str, name: str) -> str:
    """Return the module that defines a name, even if `module` only re-exports it."""
    for node in ast.parse(_source(module)).body:
        if isinstance(node, ast.ImportFrom) and any(alias.name == name for alias in node.names):
            return _definition(str(node.module), name)
    return module


def _summary(module: str, name: str) -> str:
    """Return the first line of the docstring of a function, class or constant."""
    body = ast.parse(_source(module)).body
    for node, following in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").split("\n")[0]
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        named = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if named and isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            return str(following.value.value).split("\n")[0]
    return ""
