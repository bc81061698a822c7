"""Every image of the pages has a command that draws it, and a page that shows it."""

import ast
import importlib
import sys

import pytest
from benchmarks.areas import AREAS
from tests.conftest import ROOT
from tests.docs.blocks import PAGES, PARTS, part_text

IMAGES = ROOT / "docs" / "images"


@pytest.fixture(scope="module")
def draw():
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        yield importlib.import_module("draw")
    finally:
        sys.path[:] = [path for path in sys.path if path != str(ROOT / "docs")]


def functions(path):
    return {node.name for node in ast.parse(path.read_text("utf-8")).body if isinstance(node, ast.FunctionDef)}


def test_every_image_is_listed_once_and_every_listed_one_exists(draw):
    listed = [*draw.DRAWN, *draw.BENCHMARKS, *draw.BY_HAND]
    assert sorted(listed) == sorted(path.name for path in IMAGES.iterdir())


def test_every_command_exists(draw):
    for image, module in draw.DRAWN.items():
        assert image.partition(".")[0] in functions(ROOT / "docs" / "drawing" / f"{module}.py"), image
    for image, command in draw.BENCHMARKS.items():
        program, *words = command.partition("python -m ")[2].split()
        path = ROOT / f"{program.replace('.', '/')}.py"
        if program == "benchmarks":
            assert words[1] in AREAS[words[0]], command
            (path,) = (ROOT / "benchmarks").rglob(f"{words[1]}.py")
        else:
            assert "__main__" in path.read_text("utf-8"), command
        text = path.read_text("utf-8")
        stem, _, ending = image.partition(".")
        assert image in text or (f".{ending}" in text and stem.partition("_")[0] in text) or image in command, image


def test_every_image_is_shown():
    text = "".join(page.read_text("utf-8") for page in PAGES.values())
    assert not [path.name for path in IMAGES.iterdir() if f"images/{path.name}" not in text]


def test_tutorials_begin_with_an_image():
    for part, (page, _) in PARTS.items():
        if page == "tutorials":
            assert "](images/" in part_text(part).partition("\n```")[0], part
