"""How the sources speak, counted: private words, names of constants, docstrings of public functions.

`python -m benchmarks.house.house_words ROOM ...` lists the lines of some rooms that count.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator

from benchmarks.figures import ROOT, figure

PACKAGE = ROOT / "src" / "kinefit"

_PRIVATE_WORDS = re.compile(r"\b(told|surety|whom|lastingly)\b", re.IGNORECASE)
_VAGUE = frozenset(
    """
    ABOUT AGAIN AGREE AGREED AGREES ALIKE ALONE ANYWHERE APART ASIDE AT AWAY BESIDE BETTER BEYOND BY CLEAR
    CLOSE COARSE DEEP DOUBTED ELSEWHERE ENOUGH EXACT FAIR FAR FARTHEST FEW FEWEST FINE FIRM FIRST FOLLOWED
    FREE FURTHER GIVEN GOOD GUESSED HARDLY HELD HIDDEN HIGH IN IS KEPT KNOWN LARGE LARGEST LATE LEAST LEFT
    LISTED LITTLE LONG LONGEST LOOSE LOST LOW MANY MEANT MORE MOST MOVED NEAR NEARLY NEVER NONE NOT NOTHING OF
    OFF OFTEN ONCE OUTLYING OUTSIDE PLAIN POOR RATHER READY SAME SEEN SETTLED SHORT SHOWN SLOW SMALL SOFT SOLE
    SOON STALE STATED STILL STRONG SUDDEN SURE THERE TINY TO TOGETHER TOLD TOO TRACKED TRIED TWICE UNLIKE
    UNSURE UNTOLD USUAL WEAK WELL WHOLE WIDE WIDEST WITHIN WORN WRONG YOUNG
    """.split()
)
"""Words that name no quantity: a constant that consists of such words alone says nothing of what it bounds."""

_SHAPE = re.compile(r"\((\.\.\.|[A-Za-z0-9][\w +·*−-]{0,8})(, ?(\.\.\.|[\w +·*−-]{1,9}))+\)|\(\w,\)")
_UNIT = re.compile(r"\[[^\]]+\]|\bpx\b|bool|int\b|share|number|None|count|unit")


def private_words(text: str) -> Iterator[tuple[int, str]]:
    """(line, what stands there) of every private word in a source."""
    for number, line in enumerate(text.splitlines(), 1):
        for found in _PRIVATE_WORDS.finditer(line):
            yield number, found.group()


def vague_constants(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, name) of module constants that are named by no quantity."""
    for node in tree.body:
        targets = getattr(node, "targets", [node.target] if isinstance(node, ast.AnnAssign) else [])
        names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
        for name in names:
            if name.isupper() and set(name.strip("_").split("_")) <= _VAGUE:
                yield node.lineno, name


def public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Functions and methods of public classes that are public; commands, whose docstrings are help, are left out."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            if not any("command" in ast.unparse(decorator) for decorator in node.decorator_list):
                yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (m for m in node.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_"))


def lacks_shapes(node: ast.FunctionDef) -> bool:
    """Whether arrays or numbers go in or out of which the docstring gives no shape or no unit."""
    hints = [a.annotation for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)] + [node.returns]
    given = " ".join(ast.unparse(hint) for hint in hints if hint is not None)
    text = ast.get_docstring(node) or ""
    array, number = re.search(r"NDArray|ArrayLike", given), re.search(r"\bfloat\b", given)
    return bool((array and not _SHAPE.search(text)) or (number and not _UNIT.search(text)))


def lacks_raises(node: ast.FunctionDef) -> bool:
    """Whether it raises itself and its docstring has neither a part on that nor the error's name."""
    raises = [n.exc for n in ast.walk(node) if isinstance(n, ast.Raise) and n.exc is not None]
    text = ast.get_docstring(node) or ""
    names = {ast.unparse(exc).partition("(")[0].rpartition(".")[2] for exc in raises}
    return bool(raises) and "raise" not in text.lower() and not any(name in text for name in names)


def run() -> None:
    """Print the figures of all sources."""
    texts = [path.read_text("utf-8") for path in sorted(PACKAGE.rglob("*.py"))]
    trees = [ast.parse(text) for text in texts]
    public = [node for tree in trees for node in public_functions(tree)]
    raising = [node for node in public if any(isinstance(n, ast.Raise) and n.exc is not None for n in ast.walk(node))]
    figure("house_private_words", sum(len(list(private_words(text))) for text in texts), "", "== 0")
    figure("house_vague_constants", sum(len(list(vague_constants(tree))) for tree in trees), "", "== 0")
    shapes = 100 * (1 - sum(map(lacks_shapes, public)) / len(public))
    figure("house_shapes_and_units", shapes, "% of public functions", ">= 95")
    raises = 100 * (1 - sum(map(lacks_raises, raising)) / len(raising))
    figure("house_raises", raises, "% of public functions that raise", ">= 95")


def _list(rooms: list[str]) -> None:
    for path in sorted(p for room in rooms for p in (PACKAGE / room).rglob("*.py")):
        text = path.read_text("utf-8")
        tree = ast.parse(text)
        found = [(n, f"private word: {word}") for n, word in private_words(text)]
        found += [(n, f"constant: {name}") for n, name in vague_constants(tree)]
        for node in public_functions(tree):
            found += [(node.lineno, f"shape or unit: {node.name}")] if lacks_shapes(node) else []
            found += [(node.lineno, f"Raises: {node.name}")] if lacks_raises(node) else []
        for number, what in sorted(found):
            print(f"{path.relative_to(PACKAGE)}:{number}: {what}")


if __name__ == "__main__":
    _list(sys.argv[1:])
