"""What a fresh installation takes on disk: all of it, and without what only the viewer needs."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from benchmarks.figures import LEFT_OUT, ROOT, NotMeasured, figure, quick

SHOWING = ("viser",)
_GOALS = {"install_all": "<= 600", "install_core": "<= 350"}


def run() -> None:
    """Print both sizes, and the largest packages."""
    if quick():
        raise NotMeasured(LEFT_OUT)
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    core = [one for one in needed if not one.startswith(SHOWING)]
    with tempfile.TemporaryDirectory() as work:
        whole = installed(Path(work) / "all", [[str(ROOT)]])
        least = installed(Path(work) / "core", [core, ["--no-deps", str(ROOT)]])
    largest = sorted(whole.items(), key=lambda one: -one[1])[:8]
    print("# " + ", ".join(f"{name} {size:.0f} MB" for name, size in largest))
    figure("install_all", sum(whole.values()), "MB", _GOALS["install_all"])
    figure("install_core", sum(least.values()), "MB", _GOALS["install_core"])


def installed(environment: Path, given: list[list[str]]) -> dict[str, float]:
    """[MB] of every entry that installations one after the other add to an empty environment."""
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    (folder,) = environment.glob("lib/python*/site-packages")
    before = {one.name for one in folder.iterdir()}
    for what in given:
        pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "-q", *what]
        subprocess.run(pip, check=True)
    return {one.name: _size(one) for one in folder.iterdir() if one.name not in before}


def _size(path: Path) -> float:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(one.lstat().st_size for one in files if not one.is_dir()) / 1e6
