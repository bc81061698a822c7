"""People whose spine and hips were recorded, with markers or as skeletons, and how both are learnt to go together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data
from benchmarks.scenes.motions import MOTIONS, library
from kinefit import Body, Markers, Motion, load_body, read_markers
from kinefit.fitting.markers.subject import fit_marker_subject
from kinefit.fitting.tracking.video import fit_markers
from kinefit.simulation import cut
from kinefit.simulation.retarget import known_motion

_NIMBLE = "markers/nimblephysics/data__"
_STANFORD = _NIMBLE + "grf__Subject4__MarkerData__%s1.trc"
MARKER_TAKES = {
    "pycgm": ("markers_pycgm/Test_Files/Movement_trial.c3d", "markers_pycgm/Test_Files/Static_trial.c3d"),
    "pycgm still": ("markers_pycgm/ROM/Sample_Static.c3d",),
    "cmu 01": ("markers/c3d_to_xyz/01_01.c3d",),
    "cmu 02": ("markers/momentum/momentum__examples__process_markers_app__02_01.c3d",),
    "cmu 85": ("markers/mocaprecovery/data__85_12.c3d",),
    "hdm": ("markers/mocaprecovery/data__HDM_mm_01-02_03_120.c3d",),
    "sprint": (_NIMBLE + "c3d__JA1Gait35.c3d",),
    "freeform": (_NIMBLE + "c3d__nick_freeform_001.c3d",),
    "squat": (_NIMBLE + "c3d__squat.c3d",),
    "stanford": (_STANFORD % "squats", _STANFORD % "walking", _STANFORD % "DJ"),
    "clusters": (_NIMBLE + "osim__WeirdFormatTests__markers.trc",),
}
"""Takes of each person who wears at least four markers on the pelvis and three on the thorax."""

QUICK = ("squat",)
LENGTH, RATE = amount(150, 60), 30.0  # frames of a take that are tracked, and [Hz] to which marker takes are thinned

SPINE = np.array([0.82, 0.53])
"""How far the line from the hips to the neck turns against the pelvis as the humanoid's two spine joints bend: by the
heights of these joints above the hips, 0.10 and 0.26 m, and of the neck, 0.55 m."""
TAUGHT = ("lumbar_extension", "thorax_extension", "hip_flexion_r", "hip_flexion_l")


@dataclass(frozen=True, eq=False)
class Take:
    """A recorded motion, and of whom.

    Parameters
    ----------
    person : str
    motion : Motion
    marked : with markers, its body of the person's own size; else a skeleton's, on the catalogue's body
    """

    person: str
    motion: Motion
    marked: bool


def takes() -> dict[str, Take]:
    """All takes whose recordings are there, by name."""
    out = {}
    for name, motion in library().items():
        file = MOTIONS[name][1]
        person = "cmu 07" if file.startswith("007") else "cmu 02" if file.startswith(("02", "002")) else (
            f"cmu {file[:2]}" if file[:2].isdigit() else "cmu 12" if "12_01" in file else "drawings"
        )  # fmt: skip
        out[name] = Take(person, motion, False)
    folder = data(".")
    for person, files in MARKER_TAKES.items():
        if folder is None or person not in amount(tuple(MARKER_TAKES), QUICK):
            continue
        if not all((folder / f).exists() for f in files):
            continue
        trials = [_thinned(read_markers(folder / f)) for f in files]
        subject = fit_marker_subject(load_body("humanoid"), trials)
        for k, trial in enumerate(trials):
            motion = fit_markers(subject, trial)
            out[f"{person} {k + 1}"] = Take(person, _plain(motion), True)
    return out


def _thinned(markers: Markers) -> Markers:
    step = max(round(markers.rate / RATE), 1)
    return replace(markers, positions=markers.positions[::step], rate=markers.rate / step, residual=None)


def _plain(motion: Motion) -> Motion:
    """What stands in a motion, as the truth."""
    seen = np.flatnonzero(motion.quality >= 0.5)  # the longest stretch that most markers show
    runs = np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1)
    rows = max(runs, key=len)
    own = slice(int(rows[0]), int(rows[-1]) + 1)
    return known_motion(
        motion.body, motion.rate, motion.Ts_world_root[own], motion.angles[own], up=motion.up, name=motion.name
    )


def shown(take: Take) -> Motion:
    """The part of a take that cameras are shown."""
    return cut(take.motion, 0, LENGTH)


@dataclass(frozen=True)
class Rhythm:
    """How the spine bends with the hips: of a bend between the trunk's line and the thighs it takes a share.

    Parameters
    ----------
    share : of the bend
    offset : [deg] turn of the trunk's line against the pelvis where there is no bend
    spread : [deg] by which a person departs from it, the root mean square of people left out
    """

    share: float
    offset: float
    spread: float

    @property
    def weights(self) -> dict[str, float]:
        """Of the coordinates, as a body file's coupling has them."""
        spine, hips = (1.0 - self.share) * SPINE, [0.5 * self.share] * 2
        return {name: float(w) for name, w in zip(TAUGHT, (*spine, *hips))}

    def body(self) -> Body:
        """The humanoid with what was learnt in place of what stands in its file."""
        body = uncoupled(load_body("humanoid"))
        tree, line = body.tree, np.zeros((1, len(body.tree.coordinates)))
        at = [tree.coordinate(name) for name in TAUGHT]
        line[0, at] = list(self.weights.values())
        usual = np.array(tree.usual)
        usual[at[0]] += (np.radians(self.offset) - float(line[0] @ usual)) / line[0, at[0]]
        return replace(body, tree=replace(tree, usual=usual, couplings=line / np.radians(self.spread)))


def uncoupled(body: Body) -> Body:
    """The body without couplings, its spine upright."""
    usual = np.array(body.tree.usual)
    usual[body.tree.coordinate("lumbar_extension")] = 0.0
    return replace(body, tree=replace(body.tree, usual=usual, couplings=np.empty((0, 0))))


def learnt(known: Mapping[str, Take], without: str | None = None) -> Rhythm:
    """The rhythm of all people but one, each with the same weight, taken as a line of turns over bends."""
    people = [p for p in sorted({(t.person, t.marked) for t in known.values()}) if p[0] != without]
    tables = {p: np.concatenate([_turns(t) for t in known.values() if (t.person, t.marked) == p]) for p in people}
    share, offset = _line(list(tables.values()))
    off = []
    for person, own in tables.items():
        others = [t for p, t in tables.items() if p[0] != person[0]]
        a, b = _line(others) if others else (share, offset)
        off.append(np.mean(np.square(own[:, 0] - b + a * own[:, 1])))
    return Rhythm(share, offset, float(np.sqrt(np.mean(off))))


def _line(tables: Sequence[NDArray]) -> tuple[float, float]:
    """Share and offset of turn = offset − share · bend."""
    A, b = np.zeros((2, 2)), np.zeros(2)
    for table in tables:
        columns = np.column_stack([-table[:, 1], np.ones(len(table))])
        A += columns.T @ columns / len(table)
        b += columns.T @ table[:, 0] / len(table)
    share, offset = np.linalg.solve(A, b)
    return float(share), float(offset)


def _turns(take: Take) -> NDArray:
    """(F, 2) [deg] turn of the trunk's line against the pelvis, and bend between that line and the thighs."""
    tree = take.motion.body.tree
    q = np.degrees(take.motion.angles[:, [tree.coordinate(name) for name in TAUGHT]])
    turn = q[:, :2] @ SPINE
    return np.column_stack([turn, q[:, 2:].mean(axis=1) - turn])
