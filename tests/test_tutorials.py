"""Every block of the tutorials runs, from top to bottom, as it stands."""

import os
import re
import subprocess
import sys

import pytest
from tests.conftest import ROOT

PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```", re.M | re.S)


def blocks(page):
    return BLOCK.findall(page.read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p)], ids=lambda p: p.stem)
def test_a_tutorial_runs_as_it_stands(page, tmp_path):
    tool = tmp_path / "bin" / "kinefit"
    tool.parent.mkdir()
    tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m kinefit "$@"\n')
    tool.chmod(0o755)
    work = tmp_path / "work"
    work.mkdir()
    environment = {**os.environ, "PATH": f"{tool.parent}{os.pathsep}{os.environ['PATH']}"}
    python = ""
    for kind, text in blocks(page):
        python += text if kind == "python" else ""  # later blocks know what earlier ones imported and made
        words = ["bash", "-e", "-c", text] if kind == "bash" else [sys.executable, "-c", python]
        done = subprocess.run(words, cwd=work, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"


def test_tutorials_are_all_in_their_index():
    index = (ROOT / "docs" / "tutorials" / "index.md").read_text(encoding="utf-8")
    assert {p.stem for p in PAGES} - {"index"} <= set(index.split())
