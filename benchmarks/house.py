"""The size of the house, counted in the sources: `python -m benchmarks.house`.

Import circles are none: `tests/test_house.py` holds that.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from pathlib import Path

from benchmarks.figures import figure, run_parts

PARTS = {
    "house": "code lines, questions of type, parameters, rooms and class names of the package",
    "house_words": "private words, names of constants, docstrings of public functions",
}
PACKAGE = Path(__file__).resolve().parents[1] / "src" / "kinefit"

_LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
_ASKED = re.compile(r"(Frame|Sensor|Measurement|Matched)$")
"""Ends of the class names of which a question of type is a question on sensors or frames."""

_MAX_PARAMETERS = 8


def code_lines(text: str) -> int:
    """Lines of a source without blanks, comments and docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


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


def run() -> None:
    """Print the figures."""
    texts = {path: path.read_text("utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    figure("house_code_lines", sum(map(code_lines, texts.values())), "", "<= 53000")
    figure("house_type_questions", sum(len(type_questions(tree)) for tree in trees.values()), "lines", "<= 5")
    outside = [tree for path, tree in trees.items() if not path.name.startswith("_kernels")]
    figure("house_many_parameters", sum(map(len, map(many_parameters, outside))), "functions outside kernels", "<= 20")
    rooms = Counter(path.parent for path in texts if path.name != "__init__.py" and path.parent != PACKAGE)
    room, files = rooms.most_common(1)[0]
    figure("house_largest_room", files, f"files in {room.relative_to(PACKAGE).as_posix()}", "<= 15")
    classes = Counter(n.name for tree in trees.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef))
    figure("house_class_names_twice", sum(count > 1 for count in classes.values()), "", "== 0")


if __name__ == "__main__":
    run_parts(PARTS)
