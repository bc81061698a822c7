"""Every shell block of the pages runs, in order, beside the files that its page takes for granted."""

import os
import shlex
import subprocess
import sys

import pytest
from click.testing import CliRunner
from tests.docs.blocks import PAGES, PARTS, blocks, pages
from tests.docs.command_pages import ADDED, NOT_RUN, PREPARED, RECORDED, SLOW, reason

from kinefit.cli import main

RUN = [page for page in pages("bash") if PARTS.get(page, [""])[0] != "tutorials"]  # those: tests/test_tutorials.py


def lines(text):
    """Lines of a shell block that do something, continued ones joined, without their comments."""
    return [line for one in text.replace("\\\n", " ").splitlines() if (line := one.split(" #")[0].strip())
            and line[0] != "#"]  # fmt: skip


def run(line, folder):
    """Exit code and what was said: of `kinefit` in this process, of all else in a shell."""
    words = shlex.split(line)
    if words[0] != "kinefit":
        tool = folder / "bin" / "kinefit"
        tool.parent.mkdir(exist_ok=True)
        tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m kinefit "$@"\n')
        tool.chmod(0o755)
        paths = os.pathsep.join([str(tool.parent), os.path.dirname(sys.executable), os.environ["PATH"]])
        done = subprocess.run(
            ["bash", "-e", "-c", line], cwd=folder, env={**os.environ, "PATH": paths}, capture_output=True, text=True,
            timeout=300,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr
    done = CliRunner().invoke(main, [*words[1:], *ADDED.get(words[1] if len(words) > 1 else "", ())])
    return done.exit_code, f"{done.output}\n{done.exception!r}"


def test_every_page_with_commands_is_run_and_every_reason_has_its_line():
    assert set(RUN) == set(PREPARED) and set(SLOW) <= set(RUN)
    shown = [(page, line) for page in RUN for block in blocks(page, "bash") for line in lines(block.text)]
    left = {(page, begin) for page, begin in NOT_RUN if not any(p == page and l.startswith(begin) for p, l in shown)}
    assert not left
    assert set(RUN) <= set(PAGES)


@pytest.mark.parametrize("page", [pytest.param(p, marks=[pytest.mark.slow] * (p in SLOW)) for p in RUN])
def test_commands_run_as_they_stand(page, tmp_path, monkeypatch, data_dir):
    monkeypatch.chdir(tmp_path)
    prepared = PREPARED[page](tmp_path, *([data_dir(RECORDED[page])] if page in RECORDED else []))
    for block in blocks(page, "bash"):
        next(prepared, None)
        for line in lines(block.text):
            if reason(page, line) is None:
                code, told = run(line, tmp_path)
                assert code == 0, f"{page}.md:{block.line}: {line}\n{told}"
