"""Every block of the tutorials runs, from top to bottom, as it stands, and prints what the page shows."""

import os
import re
import subprocess
import sys

import pytest
from tests.conftest import ROOT
from tests.docs.blocks import PARTS, part_text

TUTORIALS = [part for part, (page, _) in PARTS.items() if page == "tutorials"]
BLOCK = re.compile(r"^```(bash|python|text)\n(.*?)^```", re.M | re.S)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
WALK = "motion_cmu_bvh/cmu_12_01_walk.bvh"


def blocks(part):
    return BLOCK.findall(part_text(part))


@pytest.mark.slow
@pytest.mark.parametrize("part", TUTORIALS)
def test_a_tutorial_runs_as_it_stands(part, tmp_path, request):
    tool = tmp_path / "bin" / "kinefit"
    tool.parent.mkdir()
    tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m kinefit "$@"\n')
    tool.chmod(0o755)
    if "curl " in part_text(part):  # in place of the network: the same file, which was fetched before
        kept = request.getfixturevalue("data_dir")(WALK.partition("/")[0]).parent / WALK
        fetch = tool.with_name("curl")
        fetch.write_text(f'#!/bin/sh\ncase "$4" in */{kept.name}) cp "{kept}" "$3";; *) exit 22;; esac\n')
        fetch.chmod(0o755)
    work = tmp_path / "work"
    work.mkdir()
    environment = {**os.environ, "PATH": f"{tool.parent}{os.pathsep}{os.environ['PATH']}"}
    python, printed = "", []
    for kind, text in blocks(part):
        if kind == "text":
            told = printed[-len(text.splitlines()) :]
            assert [NUMBER.sub("#", line) for line in told] == [NUMBER.sub("#", line) for line in text.splitlines()]
            shown, got = ([float(n) for n in NUMBER.findall(lines)] for lines in (text, "\n".join(told)))
            assert got == pytest.approx(shown, rel=0.1, abs=2), "\n".join(told)
            continue
        python += text if kind == "python" else ""  # later blocks know what earlier ones imported and made
        words = ["bash", "-e", "-c", text] if kind == "bash" else [sys.executable, "-c", python]
        done = subprocess.run(words, cwd=work, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
        printed = done.stdout.splitlines()


def test_every_tutorial_of_the_page_is_run():
    headings = re.findall(r"^## (.*)$", (ROOT / "docs" / "tutorials.md").read_text("utf-8"), re.M)
    assert sorted(headings) == sorted(heading for page, heading in PARTS.values() if page == "tutorials")
    assert all(blocks(part) for part in TUTORIALS)
