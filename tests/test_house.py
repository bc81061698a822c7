"""The rules of the house that a machine can hold: who may import whom, short files, docstrings, kernels kept apart."""

import ast
import re
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from benchmarks.house.house_imports import circles, imported_modules, imported_names, module_name, parsed
from benchmarks.house.house_record import lost
from benchmarks.house.house_size import HOUSE_SIZE, all_lines, entries, house_size, source_size

from kinefit._doors import ROOMS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "kinefit"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# Imports run downwards only. Loose modules lie below all rooms, and only some see others of them.
LOOSE = [
    {"errors", "_doors", "_jit", "_processes", "_moved"},
    {"_arguments", "_files", "_image_headers", "_mapped", "_records", "_threads", "findings"},
    {"_pictures"},
]
_FLOORS = [*LOOSE, *({room} for room in ROOMS), {"__main__"}]
LEVEL = {part: level for level, parts in enumerate(_FLOORS) for part in parts}
SEES_THE_DOOR = {"cli", "__main__", "takes"}
FETCHES = "kinefit.readers.assets"  # what comes over the network: imported by those whom a user asked for it
MAY_FETCH = {"cli", "studio", "takes", "exporters", "readers"}
RATCHET = tomllib.loads((ROOT / "tests" / "house_size.toml").read_text("utf-8"))
SLACK = 0.005  # share by which a stored number may lie above the sources before it has to follow them down
MOST_ENTRIES = 15  # files and folders of a folder, without its __init__.py
LONGEST = {"src/kinefit/papers": 150, "src/kinefit": 500, "examples": 80}  # lines; the first that fits holds


def part_of(path: Path) -> str:
    """Top-level part of the package that a file belongs to: "geometry", "errors", "" for kinefit/__init__.py."""
    first = path.relative_to(PACKAGE).parts[0]
    return "" if first == "__init__.py" else first.removesuffix(".py")


def imported_parts(tree: ast.AST, path: Path) -> set[tuple[str, int]]:
    """Parts of kinefit that a module imports anywhere in it, with the line; "" is kinefit/__init__.py itself."""
    found = set()
    for name, line in imported_names(ast.walk(tree), path):
        part = [*name.split("."), ""][1]
        is_module = (PACKAGE / part).is_dir() or (PACKAGE / f"{part}.py").is_file()
        found.add((part if is_module or part in LEVEL else "", line))
    return found


def may_import(importer: str, imported: str) -> bool:
    """Whether one part of the house may see another."""
    if importer in (imported, ""):
        return True
    return importer in SEES_THE_DOOR if imported == "" else LEVEL[imported] < LEVEL[importer]


@pytest.mark.parametrize(
    ("importer", "imported", "allowed"),
    [
        ("geometry", "errors", True), ("geometry", "bodies", False), ("bodies", "observations", False),
        ("solving", "readers", False), ("readers", "solving", True), ("fitting", "rigs", False),
        ("fitting", "exporters", False), ("papers", "exporters", True), ("cli", "studio", True),
        ("readers", "_pictures", True), ("_pictures", "readers", False), ("fitting", "", False), ("cli", "", True),
        ("", "fitting", True), ("papers", "simulation", False),
    ],
)  # fmt: skip
def test_the_order_says_what_the_architecture_says(importer, imported, allowed):
    assert may_import(importer, imported) is allowed


def test_every_part_has_its_place():
    parts = {part_of(path) for path in SOURCES} - {""}
    assert parts == set(LEVEL), "give each room and each loose module its place in ROOMS or LOOSE of this test"
    assert len(ROOMS) <= 16


def test_only_who_is_asked_fetches_packages():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in SOURCES
        for name, line in imported_names(ast.walk(parsed(path)), path)
        if name.startswith(FETCHES) and part_of(path) not in MAY_FETCH
    ]
    assert not wrong, "\n".join(wrong)


def test_imports_are_found_in_every_form():
    forms = ("import kinefit.readers.take", "from kinefit import bodies, Body", "from ..geometry import se3")
    text = "\n".join([*forms, "def f():", " from .. import errors"])
    found = {part for part, _ in imported_parts(ast.parse(text), PACKAGE / "solving" / "x.py")}
    assert found == {"readers", "bodies", "", "geometry", "errors"}


def test_imports_run_downwards():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports kinefit.{imported}"
        for path in SOURCES
        for imported, line in sorted(imported_parts(parsed(path), path))
        if not may_import(part_of(path), imported)
    ]
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other_in_a_circle():
    modules = {module_name(path) for path in SOURCES}
    order = TopologicalSorter({module_name(path): imported_modules(path, modules) for path in SOURCES})
    try:
        order.prepare()
    except CycleError as error:
        circle = " <- ".join(error.args[1])
        pytest.fail(f"{circle}: move what they share into a module below both; no import inside a function helps")


def test_a_class_name_means_one_thing():
    homes: dict[str, list[str]] = {}
    for path in SOURCES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    wrong = [f"class {name} is in {', '.join(places)}" for name, places in homes.items() if len(places) > 1]
    assert not wrong, "\n".join([*wrong, "Name each by what it is, or make them one."])


def test_rooms_are_small():
    rooms = {path.parent for path in SOURCES} - {PACKAGE}
    sizes = {room: len(entries(room)) for room in rooms}
    wrong = [f"{room.relative_to(ROOT)}: {size} entries" for room, size in sizes.items() if size > MOST_ENTRIES]
    remedy = f"{MOST_ENTRIES} are allowed: split by what is imported together, or join files."
    assert not wrong, "\n".join([*sorted(wrong), remedy])


def test_files_are_short():
    wrong = []
    for folder in ("src", "examples"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            longest = next(lines for start, lines in LONGEST.items() if name.startswith(start + "/"))
            if (lines := len(path.read_text("utf-8").splitlines())) > longest:
                wrong.append(f"{name}: {lines} lines, {longest} are allowed")
    assert not wrong, "\n".join(wrong)


def test_sizes_are_counted_without_blanks_comments_and_docstrings():
    words = '"""Module\n\nof two."""\n\nimport x  # why\n_A, _B = 3, 0.5\n'
    text = words + 'def f(\n    a,\n):\n    """One."""\n    return a\n'
    assert dict(source_size(text)) == {"code_lines": 6, "statements": 6, "tokens": 18, "literals": 1, "constants": 1}


@pytest.mark.parametrize("unit", [*HOUSE_SIZE, "all_lines", "circles"])
def test_the_house_does_not_grow(unit):
    counts = {"all_lines": all_lines, "circles": lambda: len(circles(types=True))}
    size, stored = counts.get(unit, lambda: house_size()[unit])(), RATCHET[unit]
    assert size <= stored, f"{size} {unit}, {stored} are allowed: delete what the change supersedes"
    lower = f"{size} {unit}: write that number into tests/house_size.toml, so that the house stays as small"
    assert size >= stored * (1 - SLACK), lower


def test_no_capability_is_lost():
    assert not lost(), "\n".join([*lost(), "Bring it back, or list it with the reason in house_record.py."])


def public_without_docstring(body: list[ast.stmt], prefix: str = "") -> list[str]:
    """Names of public classes, functions and methods that say nothing."""
    found = []
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        marks = [ast.unparse(mark) for mark in node.decorator_list]
        if not ast.get_docstring(node) and not any(mark.endswith((".setter", "overload")) for mark in marks):
            found.append(f"{node.lineno} {prefix}{node.name}")
        if isinstance(node, ast.ClassDef):
            found += public_without_docstring(node.body, f"{node.name}.")
    return found


def test_everything_public_says_what_it_is():
    wrong = []
    for path in SOURCES:
        tree = parsed(path)
        missing = public_without_docstring(tree.body)
        if tree.body and not ast.get_docstring(tree):
            missing.insert(0, "1 the module itself")
        wrong += [f"{path.relative_to(ROOT)}:{name}" for name in missing]
    assert not wrong, "\n".join(wrong)


def test_only_kernels_know_the_compiler():
    wrong = []
    for path in SOURCES:
        if path.name == "_jit.py" or path.name.startswith("_kernels"):
            continue
        for node in ast.walk(parsed(path)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "numba" for name in names):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not wrong, "\n".join(wrong)


def test_no_file_names_a_folder_of_one_machine():
    own = re.compile(r"(?<![\w.~}/$-])/(?:work|home|root|opt|mnt|Users)/\w")
    assert own.search('open("/' 'home/me/x")') and not own.search("a/work/b ~/work")
    kept = {".py", ".toml", ".md", ".txt", ".cfg", ".yml", ".yaml", ".sh", ""}
    folders = [ROOT / name for name in ("src", "tests", "docs", "examples", "benchmarks", ".ci")]
    files = [path for path in ROOT.iterdir() if path.is_file()]
    files += [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    wrong = []
    for path in files:
        skip = {"__pycache__", "_build", "generated"} & set(path.relative_to(ROOT).parts)
        if skip or path.suffix not in kept or path.name.startswith((".coverage", ".git")):
            continue
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
            if own.search(line):
                wrong.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not wrong, "\n".join(wrong)


def test_the_readme_has_the_two_commands_that_the_checks_run():
    readme = (ROOT / "README.md").read_text("utf-8")
    for name in ("demo command", "test command"):
        after = readme.partition(f"<!-- {name} -->")[2]
        command = re.match(r"\s*```bash\n([^\n]+)\n```", after)
        assert command, f"README.md: no single shell line after <!-- {name} -->"
        assert command[1].startswith("python3 -m venv")


_PACKAGES = {
    "cv2": "opencv-python-headless", "ai_edge_litert": "ai-edge-litert", "mcap_ros2": "mcap-ros2-support",
    "rerun": "rerun-sdk", "ndx_pose": "ndx-pose", "pxr": "usd-core", "yaml": "pyyaml",
}  # fmt: skip


def test_only_packages_that_are_declared_are_imported():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    told = list(stated["dependencies"])
    for extra, packages in stated["optional-dependencies"].items():
        told += packages if extra not in ("test", "docs") else []
    declared, own = {re.match(r"[\w-]+", one)[0] for one in told}, {"kinefit", "", *sys.stdlib_module_names}
    wrong = []
    for path in SOURCES:
        for node in ast.walk(parsed(path)):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            for top in {module.split(".")[0] for module in modules} - own:
                if _PACKAGES.get(top, top) not in declared:
                    wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}: {top}")
    assert not wrong, "\n".join(wrong)
