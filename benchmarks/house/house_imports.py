"""Who imports whom in the package, and the circles of that."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.figures import ROOT

PACKAGE = ROOT / "src" / "kinefit"


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file: every rule looks at the same one."""
    return ast.parse(path.read_text("utf-8"))


def imported_names(nodes: Iterable[ast.AST], path: Path) -> list[tuple[str, int]]:
    """Dotted names of kinefit that statements of a module import, with the line."""
    package = ["kinefit", *path.relative_to(PACKAGE).parts[:-1]]
    found = []
    for node in nodes:
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        found += [(name, node.lineno) for name in names if name.split(".")[0] == "kinefit"]
    return found


def module_name(path: Path) -> str:
    """Dotted name of a module or package by its file."""
    return ".".join(["kinefit", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")


def imported_modules(path: Path, modules: set[str], types: bool = False) -> set[str]:
    """Modules that run before a module can: those it imports, in functions too, and the packages these are in.

    With `types`, also those that only its types name.
    """
    own, found = module_name(path), set()
    for name, _ in imported_names(ast.walk(parsed(path)) if types else statements_that_run(parsed(path)), path):
        while name not in modules:
            name = name.rpartition(".")[0]
        parts = name.split(".")
        found |= {".".join(parts[:k]) for k in range(2, len(parts))} | {name}
    return {name for name in found if name != own and not own.startswith(f"{name}.")}


def statements_that_run(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a syntax tree but those below `if TYPE_CHECKING`."""
    yield tree
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield from statements_that_run(node)


def circles(types: bool) -> list[list[str]]:
    """Groups of modules that import each other, around corners too; with `types`, for the names of types as well."""
    paths = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
    modules = sorted({*paths, "kinefit"})
    number = {name: k for k, name in enumerate(modules)}
    pairs = [(number[a], number[b]) for a in paths for b in imported_modules(paths[a], {*modules}, types)]
    rows, columns = np.array(pairs).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(modules),) * 2)
    _, labels = connected_components(graph, connection="strong")
    groups = [[modules[k] for k in np.flatnonzero(labels == label)] for label in np.unique(labels)]
    return [group for group in groups if len(group) > 1]


_UNPICKLING = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
MACHINE_CODE = {"_jit.py"}
"""numba pickles compiled kernels: machine code, which runs in any format. So the folder is the user's alone."""


def unpickling_modules() -> list[str]:
    """Modules of kinefit that could unpickle: they import what does, or let numpy do it; but for `MACHINE_CODE`."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        names = set()
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names |= {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
            names |= {"pickle"} if isinstance(node, ast.keyword) and node.arg == "allow_pickle" else set()
        if {name.partition(".")[0] for name in names} & _UNPICKLING:
            found.append(path.relative_to(PACKAGE).as_posix())
    return [name for name in found if name not in MACHINE_CODE]
