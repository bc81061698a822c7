"""The wheel that is released holds what users need, and nothing else."""

import importlib.util
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "kinefit"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("hatchling, which builds the wheel, is not installed")
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (made,) = out.glob("*.whl")
    with zipfile.ZipFile(made) as archive:
        yield archive


def test_it_holds_every_file_of_the_package(wheel):
    there = {Path(name) for name in wheel.namelist()}
    wanted = {
        path.relative_to(ROOT / "src") for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }  # fmt: skip
    assert wanted <= there
    assert Path("kinefit/py.typed") in there  # so that type checkers read the annotations
    catalogue = {path.name for path in (PACKAGE / "bodies" / "toml" / "catalogue").glob("*.toml")}
    assert catalogue and catalogue <= {path.name for path in there if path.parent.name == "catalogue"}


def test_it_holds_nothing_else(wheel):
    rooms = {name.partition("/")[0] for name in wheel.namelist()}
    assert len(rooms) == 2 and "kinefit" in rooms  # and what is told about it
    for name in wheel.namelist():
        assert not re.search(r"(^|/)(tests|benchmarks|docs|examples|__pycache__)/", name), name
    assert sum(entry.file_size for entry in wheel.infolist()) < 12e6


def test_it_needs_no_compiler_and_tells_licence_and_command(wheel):
    (about,) = (name for name in wheel.namelist() if name.endswith(".dist-info/WHEEL"))
    assert "Tag: py3-none-any" in wheel.read(about).decode()
    folder = about.rpartition("/")[0]
    told = wheel.read(f"{folder}/METADATA").decode()
    assert "License-Expression: Apache-2.0" in told and "Requires-Python: <3.14,>=3.11" in told
    assert "kinefit = kinefit.cli:main" in wheel.read(f"{folder}/entry_points.txt").decode()
    assert {"LICENSE", "NOTICE"} <= {name.rpartition("/")[2] for name in wheel.namelist() if "/licenses/" in name}
