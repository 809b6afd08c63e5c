"""The role ``src``: a file of the repository, or a name in it, which must exist.

    {src}`teachers/dynamic_rules.py`                  the file
    {src}`teachers/dynamic_rules.py:has_converged`    a function, class, method or constant that it defines

A missing file or name is a warning, and so an error of the build.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst.states import Inliner
from sphinx.application import Sphinx
from sphinx.util import logging

ROOT = Path(__file__).resolve().parents[2]
logger = logging.getLogger(__name__)


@cache
def names_in(path: Path) -> frozenset[str]:
    """Return all top-level names of a module, and ``Class.member`` of its classes."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        found |= _defined(node)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{name}" for inner in node.body for name in _defined(inner)}
    return frozenset(found)


def _defined(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return {node.target.id}
    return set()


def mistake_in(reference: str) -> str:
    """Return the problem with ``path`` or ``path:name``; empty if both exist."""
    file, _, name = reference.partition(":")
    path = ROOT / file
    if not path.exists():
        return f"no file is called {file}"
    if name and name not in names_in(path):
        return f"{file} defines no {name}"
    return ""


def source(
    role: str, rawtext: str, text: str, line: int, inliner: Inliner, *_: Any
) -> tuple[list[nodes.Node], list[nodes.system_message]]:
    """Return the role's nodes: the file in code type, preceded by the name, if any."""
    if mistake := mistake_in(text):
        location = (inliner.document.settings.env.docname, line)
        logger.warning("src role: %s", mistake, location=location)
    file, _, name = text.partition(":")
    shown: list[nodes.Node] = [nodes.literal(file, file)]
    if name:
        shown = [nodes.literal(name, name), nodes.Text(" in "), *shown]
    return shown, []


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_role("src", source)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
