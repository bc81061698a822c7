"""Small inputs after public reports whose left, right or labels are wrong, and siblings of the same kinds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from benchmarks.commands import answer
from benchmarks.figures import data
from benchmarks.robustness.faults_sides import exchanged, mirrored
from kinefit.exporters import write_markers
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers

_WORLD, _LABELS = "mirrored (left-handed)", "labels are exchanged"
_STANFORD = "data__grf__Subject4__MarkerData__%s1.trc"


def _part(name: str, frames: int = 60, folder: str = "markers/nimblephysics") -> Markers:
    """The first frames of a real take."""
    root = data(folder)
    assert root is not None
    whole = read_markers(root / name)
    residual = None if whole.residual is None else whole.residual[:frames]
    return Markers(whole.names, whole.rate, whole.positions[:frames], residual=residual, up=whole.up)


def _take(folder: Path, markers: Markers, name: str, extra: str = "") -> Path:
    """A take file with these markers alone."""
    write_markers(markers, folder / name)
    take = folder / "take.toml"
    take.write_text(f'[take]\nup = "y"\n\n[[markers]]\nfile = "{name}"\n{extra}', "utf-8")
    return take


def _mirrored_world(folder: Path) -> bool:
    code, text = answer("markers", "fit", folder / "walk.trc", "--formats", "mot", "-o", folder.name + "-none")
    return code == 2 and _WORLD in text


def _sides_exchanged(folder: Path) -> bool:
    code, text = answer("markers", "fit", folder / "walk.trc", "--formats", "mot", "-o", folder.name + "-none")
    return code == 2 and _LABELS in text


def _track(folder: Path, markers: Markers, name: str, words: str) -> bool:
    code, text = answer("track", _take(folder, markers, name), "-o", folder / "out")
    return code == 2 and words in text and name in text


def _check(folder: Path, markers: Markers, name: str, words: str) -> bool:
    code, text = answer("check", _take(folder, markers, name), "--strict", "-o", folder / "check.html")
    return code == 2 and words in text


def _audit(folder: Path, markers: Markers, words: str) -> bool:
    write_markers(markers, folder / "take.c3d")
    code, text = answer("markers", "audit", folder / "take.c3d", "--strict")
    return code == 2 and words in text


def _mended(folder: Path) -> bool:
    """With `sides` the wrong take is tracked like the right one."""
    wrong = exchanged(_part(_STANFORD % "walking", 30))
    code, _ = answer("track", _take(folder, wrong, "walk.trc", 'sides = "exchanged"\n'), "-o", folder / "out")
    return code == 0


CASES: dict[str, Callable[[Path], bool]] = {
    "markers-mirrored-world": _mirrored_world,
    "markers-sides-exchanged-whole-body": _sides_exchanged,
}
SIBLINGS: dict[str, Callable[[Path], bool]] = {
    "sides: mirrored squats as TRC, to track": lambda to: _track(
        to, mirrored(_part(_STANFORD % "squats")), "squats.trc", _WORLD),
    "sides: mirrored jump as C3D, to check": lambda to: _check(
        to, mirrored(_part(_STANFORD % "DJ"), 0), "jump.c3d", _WORLD),
    "sides: exchanged walk as C3D, to track": lambda to: _track(
        to, exchanged(_part(_STANFORD % "walking")), "walk.c3d", _LABELS),
    "sides: exchanged walk, to audit": lambda to: _audit(
        to, exchanged(_part(_STANFORD % "walking")), _LABELS),
    "sides: knees exchanged, to audit": lambda to: _audit(
        to, exchanged(_part(_STANFORD % "walking"), ("r_knee", "L_knee")), "r_knee and L_knee are exchanged"),
    "sides: heel and toe exchanged, to audit": lambda to: _audit(
        to, exchanged(_part(_STANFORD % "walking"), ("r_calc", "r_toe")), "r_calc and r_toe are exchanged"),
    "sides: exchanged walk, sides stated": _mended,
}  # fmt: skip
