"""Messages: short whatever a file holds, and commands that work when pasted."""

import os
import shlex
from pathlib import Path

import pytest

from kinefit.errors import FileError, KinefitError, command, nearest, printable, shortened, spelled


def test_a_message_stays_short_whatever_a_file_gave_it():
    error = FileError("x" * 10_000, file="walk.c3d", place="y" * 10_000, remedy="Copy it again.")
    assert len(str(error)) < 600 and str(error).endswith("Copy it again.")
    assert shortened("short") == "short"
    assert shortened("a" * 1000 + "b" * 1000).startswith("aaa") and shortened("a" * 1000 + "b" * 1000).endswith("bbb")


def test_a_message_names_file_place_problem_and_remedy():
    error = KinefitError("no rate", file="take.toml", place="[take]", remedy="Write it.")
    assert str(error) == "take.toml, [take]: no rate. Write it."
    assert (error.problem, error.file, error.place, error.remedy) == ("no rate", "take.toml", "[take]", "Write it.")


def test_a_command_is_quoted_and_starts_where_the_user_is(tmp_path, monkeypatch):
    folder = tmp_path / "my takes" / "it's monday"
    folder.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    line = command("track", folder / "take.toml", "--out", "here")
    assert shlex.split(line) == ["kinefit", "track", "my takes/it's monday/take.toml", "--out", "here"]
    monkeypatch.chdir(folder)
    assert nearest(folder / "take.toml") == "take.toml"
    assert nearest(folder.parent / "b.toml") == "../b.toml"
    assert nearest("/") == "/"


@pytest.mark.parametrize(("text", "name"), [("OpenSim", "opensim"), ("H-Anim", "hanim"), ("xyz", "xyz")])
def test_names_are_known_however_they_are_spelled(text, name):
    assert spelled(text, ("opensim", "hanim")) == name


def test_names_that_are_not_utf8_are_printable():
    name = os.fsdecode(b"rec\xff")
    error = FileError(f"{name} is wrong", file=f"/{name}/take.toml", place=name, remedy=f"Rename {name}.")
    assert str(error) == "/rec?/take.toml, rec?: rec? is wrong. Rename rec?." and str(error).encode("utf-8")
    assert error.file == f"/{name}/take.toml" and printable(Path(name)) == "rec?" and printable("Größe €") == "Größe €"
