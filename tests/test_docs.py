"""What the documentation shows exists: commands and their options, imports, keys of TOML, commands of benchmarks."""

import ast
import importlib
import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest
from benchmarks.areas import AREAS

from kinefit.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "generated" not in p.parts)]
SHOWN = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


def blocks(page, kind):
    return [text for name, text in SHOWN.findall(page.read_text("utf-8")) if name == kind]


def pages(kind):
    return [pytest.param(p, id=p.relative_to(ROOT).as_posix()) for p in PAGES if blocks(p, kind)]


def commands(text):
    """The words of every `kinefit ...` in shell text."""
    for line in text.replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|\|\||;|\|", line.split(" #")[0]):
            words = shlex.split(part)
            while words and "=" in words[0]:
                words = words[1:]
            if words and Path(words[0]).name == "kinefit":
                yield words[1:]


def unknown(words):
    """What is wrong with a command line; None for nothing."""
    context, command = click.Context(main), main
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        if found is None:
            return f"no command {words[0]}"
        context, command, words = click.Context(found, parent=context), found, words[1:]
    options = {o for p in command.get_params(context) for o in (*p.opts, *p.secondary_opts)}
    wrong = [w for w in words if re.match(r"--?[a-z]", w) and w.split("=")[0] not in options]
    return f"no option {wrong[0]} of {command.name}" if wrong else None


@pytest.mark.parametrize("page", pages("bash"))
def test_commands_and_their_options_are_there(page):
    wrong = [(words, what) for text in blocks(page, "bash") for words in commands(text) if (what := unknown(words))]
    assert not wrong


def test_a_wrong_command_is_found():
    assert unknown(["track", "take.toml", "--smoth"]) == "no option --smoth of track"
    assert unknown(["calibrate", "bord"]) == "no command bord"
    assert unknown(["markers", "fit", "walk.c3d", "--out", "walk"]) is None
    assert list(commands("A=1 kinefit demo --out x && kinefit view x # all")) == [["demo", "--out", "x"], ["view", "x"]]


@pytest.mark.parametrize("page", pages("python"))
def test_imports_are_there(page):
    for text in blocks(page, "python"):
        code = "\n".join(re.sub(r"^(>>>|\.\.\.) ?", "", line) for line in text.splitlines() if text[:3] != ">>>" or
                         line.startswith((">>>", "...")))  # fmt: skip
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "kinefit":
                module = importlib.import_module(node.module)
                for name in node.names:
                    if name.name != "*" and not hasattr(module, name.name):
                        importlib.import_module(f"{node.module}.{name.name}")


@pytest.mark.parametrize("page", pages("toml"))
def test_toml_can_be_read(page):
    for text in blocks(page, "toml"):
        tomllib.loads(text)


def test_parts_of_benchmarks_are_there():
    pattern = re.compile(r"python -m benchmarks ([a-z]\w*)([^`]*)`")
    shown = [one for page in PAGES for one in pattern.findall(page.read_text("utf-8"))]
    assert len(shown) > 45
    for area, parts in shown:
        assert area in AREAS, area
        named = re.findall(r"(?<=\s)[a-z]\w+", parts) if AREAS[area] else []
        assert AREAS[area].keys() >= {*named}, (area, parts)


def test_every_part_of_benchmarks_is_one_module():
    modules = [path.stem for path in (ROOT / "benchmarks").rglob("*.py") if path.stem != "__init__"]
    parts = [part for area, named in AREAS.items() for part in (named or [area])]
    assert len(parts) > 100 and [part for part in parts if modules.count(part) != 1] == []


def test_folders_of_benchmarks_are_small():
    folders = {path.parent for path in (ROOT / "benchmarks").rglob("*.py")}
    entries = {folder: [one for one in folder.iterdir() if one.name != "__pycache__"] for folder in folders}
    assert len(folders) > 20
    assert [f"{folder}: {len(names)}" for folder, names in entries.items() if len(names) > 15] == []
