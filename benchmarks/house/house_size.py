"""The size of the house, counted in the sources: `python -m benchmarks house`."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from functools import cache
from pathlib import Path

from benchmarks.figures import ROOT, figure
from benchmarks.house.house_imports import PACKAGE, circles, parsed
from kinefit._doors import ROOMS, names_of

_LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
_CAPITALS = re.compile(r"\(?_?[A-Z][A-Z0-9_]*(, _?[A-Z][A-Z0-9_]*)*\)?$")
HOUSE_SIZE = ("code_lines", "statements", "tokens", "literals", "constants")
"""What the ratchet of `tests/test_house.py` holds."""

_ASKED = re.compile(r"(Frame|Sensor|Measurement|Matched)$")
"""Ends of the class names of which a question of type is a question on sensors or frames."""

_MAX_PARAMETERS = 8


def source_size(text: str, tree: ast.Module | None = None) -> Counter[str]:
    """Size of one source in every unit of `HOUSE_SIZE`: code lines, statements, tokens, literals, constants.

    Blanks, comments and docstrings count nothing but as a statement each. Literals are numbers other than 0, 1, 2 and
    a half; constants are statements of a module that give a value to a name in capitals.
    """
    tree, lines, size = tree or ast.parse(text), set(), Counter(dict.fromkeys(HOUSE_SIZE, 0))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
            size["tokens"] += 1
    for node in ast.walk(tree):
        size["statements"] += isinstance(node, ast.stmt)
        size["literals"] += isinstance(node, ast.Constant) and _is_literal(node.value)
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node) is not None:
            lines.difference_update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
            size["tokens"] -= 1
    for node in tree.body:
        targets = getattr(node, "targets", [node.target] if isinstance(node, ast.AnnAssign) else [])
        size["constants"] += any(_CAPITALS.match(ast.unparse(target)) for target in targets)
    return size + Counter({"code_lines": len(lines)})


def _is_literal(value: object) -> bool:
    return isinstance(value, int | float | complex) and not isinstance(value, bool) and value not in (0, 1, 2, 0.5)


def code_lines(text: str) -> int:
    """Lines of a source without blanks, comments and docstrings."""
    return source_size(text)["code_lines"]


def type_questions(tree: ast.AST) -> set[int]:
    """Lines that ask with `isinstance` whether something is some sensor, frame, measurement or match."""
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "isinstance"]
    return {
        call.lineno for call in calls
        for name in ast.walk(call.args[1])
        if _ASKED.search(getattr(name, "id", "") or getattr(name, "attr", ""))
    }  # fmt: skip


def many_parameters(tree: ast.AST) -> list[str]:
    """Functions with more than eight parameters, `self` and `cls` not counted."""
    out = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            a = node.args
            names = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs) if one.arg not in ("self", "cls")]
            out += [node.name] if len(names) + bool(a.vararg) + bool(a.kwarg) > _MAX_PARAMETERS else []
    return out


def entries(room: Path) -> list[str]:
    """Files and folders of a folder, without its `__init__.py`."""
    return [entry.name for entry in room.iterdir() if not entry.name.startswith("__")]


def imported_lines(tree: ast.AST) -> int:
    """Lines of import statements."""
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in nodes)


@cache
def house_size() -> Counter[str]:
    """Size of the whole package."""
    sizes = (source_size(path.read_text("utf-8"), parsed(path)) for path in sorted(PACKAGE.rglob("*.py")))
    return sum(sizes, Counter())


@cache
def all_lines() -> int:
    """Lines that are not blank of the package with its pages' scripts, styles and tables, of tests and benchmarks."""
    kinds = {"src": {".py", ".js", ".css", ".toml"}, "tests": {".py", ".toml"}, "benchmarks": {".py", ".toml"}}
    files = (path for folder, ends in kinds.items() for path in (ROOT / folder).rglob("*") if path.suffix in ends)
    return sum(sum(bool(line.strip()) for line in path.read_text("utf-8").splitlines()) for path in files)


def run() -> None:
    """Print the figures."""
    trees = {path: parsed(path) for path in sorted(PACKAGE.rglob("*.py"))}
    size = house_size()
    figure("house_code_lines", size["code_lines"], "", "<= 60000")
    figure("house_statements", size["statements"], "", "<= 57000")
    figure("house_tokens", size["tokens"], "", "<= 750000")
    figure("house_literals", size["literals"], "numbers but 0, 1, 2, a half", "<= 5850")
    figure("house_constants", size["constants"], "of modules", "<= 1380")
    figure("house_all_lines", all_lines(), "of package, pages, tests and benchmarks", "<= 161000")
    figure("house_circles", len(circles(types=True)), "groups of modules, types counted", "== 0")
    figure("house_type_questions", sum(len(type_questions(tree)) for tree in trees.values()), "lines", "<= 5")
    outside = [tree for path, tree in trees.items() if not path.name.startswith("_kernels")]
    figure("house_many_parameters", sum(map(len, map(many_parameters, outside))), "functions outside kernels", "<= 20")
    rooms = [path.parent for path in trees if path.name == "__init__.py" and path.parent.parent == PACKAGE]
    figure("house_rooms", len(rooms), "", "<= 16")
    figure("house_door", len(set(names_of("kinefit")) - set(ROOMS)), "names beside the rooms", "<= 45")
    sizes = {path.parent: len(entries(path.parent)) for path in trees if path.parent != PACKAGE}
    room = max(sizes, key=lambda room: sizes[room])
    figure("house_largest_room", sizes[room], f"entries in {room.relative_to(PACKAGE).as_posix()}", "<= 15")
    imports = sum(imported_lines(tree) for tree in trees.values())
    figure("house_imports", 100.0 * imports / size["code_lines"], "% of code lines", "<= 8")
    own = [path.read_text("utf-8") for path in sorted((ROOT / "benchmarks").rglob("*.py"))]
    figure("house_benchmarks", sum(source_size(text)["code_lines"] for text in own), "code lines", "<= 12000")
    pages = [path.read_text("utf-8") for path in sorted((ROOT / "docs").rglob("*.md")) if "generated" not in path.parts]
    figure("house_pages", len(pages) - 1, "pages beside the index", "<= 40")
    figure("house_page_words", sum(len(text.split()) for text in pages), "words", "<= 70000")
    classes = Counter(n.name for tree in trees.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef))
    figure("house_class_names_twice", sum(count > 1 for count in classes.values()), "", "== 0")
