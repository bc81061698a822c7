"""Processes of ours in a folder of strangers: nothing that lies there is imported or run."""

import os
import sys

import pytest
from tests.strangers import ROADS, code_that_runs

from kinefit._processes import environment, program, python, starting


@pytest.mark.parametrize("road", ROADS)
def test_no_code_of_a_folder_of_recordings_runs(road, tmp_path):
    assert code_that_runs(road, tmp_path) == []


def test_search_paths_are_without_the_current_folder(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", ".", "/a/lib", "./"]))
    monkeypatch.setenv("PATH", os.pathsep.join([".", "/a/bin", "", "/b"]))
    found = environment(MORE="x")
    assert found["PYTHONPATH"] == "/a/lib" and found["PATH"] == os.pathsep.join(["/a/bin", "/b"])
    assert found["PYTHONSAFEPATH"] == "1" and found["MORE"] == "x"
    assert python("-m", "pip") == [sys.executable, "-P", "-m", "pip"]


def test_environment_and_search_path_come_back(monkeypatch):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    before, path = dict(os.environ), sys.path
    with pytest.raises(KeyError), starting(OMP_NUM_THREADS="3"):
        assert os.environ["PYTHONSAFEPATH"] == "1" and os.environ["OMP_NUM_THREADS"] == "3" and "" not in sys.path
        raise KeyError
    assert dict(os.environ) == before and sys.path is path


@pytest.mark.skipif(sys.platform == "win32", reason="programs of Windows have other endings")
def test_a_program_of_the_current_folder_is_none(tmp_path, monkeypatch):
    (tmp_path / "npm").write_text("#!/bin/sh\n")
    (tmp_path / "npm").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    for path in (".", "", str(tmp_path), "./node_modules/../"):
        monkeypatch.setenv("PATH", path)
        assert program("npm") is None
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program("npm") == str(tmp_path / "npm")
