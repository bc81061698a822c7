"""Places of results: refused before anything is computed, where they cannot be written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

from kinefit.errors import ExportError


def no_format(name: str, valid: Iterable[str]) -> str:
    """What to say of a format that there is not."""
    problem = f"no format '{name}'; there are: {', '.join(valid)}"
    if name.lower().strip(".") == "fbx":
        problem += ". kinefit does not write FBX: use glb or bvh, which Blender, Unity and Unreal import"
    return problem


def check_folder(folder: Path, option: str = "--out") -> None:
    """Raise ExportError for a folder that cannot be written, before anything is computed; leave nothing there."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    remedy = f"Give another path with {option}."
    if not there.is_dir():
        raise ExportError("a file of that name is in the way", file=there, remedy=remedy)
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        problem = f"this folder cannot be written ({error.strerror})"
        raise ExportError(problem, file=there, remedy=remedy) from error


def check_file(path: Path, option: str = "--out") -> None:
    """Raise ExportError for a file that cannot be written, before anything is computed; leave nothing there."""
    if path.is_dir():
        raise ExportError("a folder of that name is in the way", file=path, remedy=f"Give another file with {option}.")
    check_folder(path.absolute().parent, option)


def check_new(path: Path, overwrite: bool = False, remedy: str = "Add --overwrite, or give another --out.") -> None:
    """Raise ExportError for a file that cannot be written, or that exists."""
    if path.exists() and not overwrite:
        raise ExportError("the file already exists", file=path, remedy=remedy)
    check_file(path)
