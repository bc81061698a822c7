"""Cycles of a repeated movement: steps of gait found at the feet, other movements by how they repeat.

Gait: a foot strikes where its heel is farthest in front of the pelvis and leaves where it is farthest behind (Zeni,
Richards and Higginson 2008, "Two simple methods for determining gait events during treadmill and overground walking
using kinematic data", Gait & Posture 27:710-714, the coordinate-based method). In front is where the pelvis points, so
that it holds on a treadmill too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_table
from kinefit.errors import FileError
from kinefit.motion import Motion, rotation_between_up

PERCENT = np.arange(101.0)
_MIN_STRIDE_S, _MAX_STRIDE_S = 0.4, 3.0  # [s] of a stride: sprinters take 0.45 s, people who hardly walk 2.5 s
_STEP = 0.12  # share of the stature that a foot travels to and fro at least: shuffling 20 cm strides of an adult
_EVEN = 0.25  # coefficient of variation of the durations above which a movement is not a repeated one
_MIN_CORRELATION = 0.75  # coefficient of multiple correlation; 0.75 and more is called good (Garofalo et al. 2009)
_GAIT = ("hip_flexion", "knee_angle")  # the curves that must be alike; every lower limb here has them


@dataclass(frozen=True, eq=False)
class Side:
    """The cycles of one side of the body.

    Parameters
    ----------
    name : "left", "right", or "both" for a movement that is no gait.
    spans : (N, 2) int, first frame and frame of the next start.
    toe_off : (N,) [%] of each cycle, NaN where none was found; empty where the movement is no gait.
    """

    name: str
    spans: NDArray
    toe_off: NDArray


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles of a motion.

    Parameters
    ----------
    kind : "gait" or "repeated movement"
    sides : those with two or more cycles.
    likeness : float, Kadaba's coefficient of multiple correlation of the curves over the cycles, 0..1.
    """

    kind: str
    sides: tuple[Side, ...]
    likeness: float


def find_cycles(motion: Motion) -> Cycles | None:
    """The cycles of a motion, None where it does not clearly repeat itself.

    A repeated movement has two or more cycles that last about as long (coefficient of variation at most 25 %) and look
    alike (coefficient of multiple correlation at least 0.75). Cycles in which nobody was seen for a frame are left out.
    """
    if len(motion) < 3 or len(motion) / motion.rate < 2 * _MIN_STRIDE_S:
        return None
    return _gait(motion) or _repeated(motion)


def normalised(values: NDArray, spans: NDArray) -> NDArray:
    """Curves (N, 101, ...) over 0..100 % of the spans (N, 2) of values (F, ...), linear between frames."""
    out = np.empty((len(spans), len(PERCENT), *values.shape[1:]))
    for k, (start, stop) in enumerate(spans):
        at = start + PERCENT / 100 * (stop - start)
        low = np.minimum(at.astype(int), len(values) - 2)
        share = (at - low).reshape(-1, *(1,) * (values.ndim - 1))
        out[k] = values[low] * (1 - share) + values[low + 1] * share
    return out


def likeness(curves: NDArray) -> float:
    """Coefficient of multiple correlation 0..1 of cycles (N, T) (Kadaba et al. 1989, J. Orthop. Res. 7:849-860).

    1 where all curves are the same, 0 where they have nothing in common (or do not move). For (N, T, D) that of D
    curves together, each about its own mean, so that those which move most count most.
    """
    curves = curves.reshape(*curves.shape[:2], -1)
    N, T, _ = curves.shape
    if N < 2:
        return 0.0
    within = np.sum((curves - curves.mean(axis=0)) ** 2) / (T * (N - 1))
    total = np.sum((curves - curves.mean(axis=(0, 1))) ** 2) / (T * N - 1)
    return float(np.sqrt(max(0.0, 1 - within / total))) if total > 1e-12 else 0.0


def foot_ahead(motion: Motion, side: str) -> NDArray | None:
    """(F,) [m] how far a heel is in front of the pelvis, horizontally; None where the body has no heels.

    The pelvis points at right angles to the line between the hips, so that it holds when it tilts.
    """
    names = ("l_heel", "r_heel", "l_hip", "r_hip")
    if any(name not in motion.body.landmarks.names for name in names):
        return None
    left, right, hip_l, hip_r = np.moveaxis(_upright(motion, names), 1, 0)
    forward = np.cross([0.0, 1.0, 0.0], hip_r - hip_l)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    heel = left if side == "l" else right
    return np.sum((heel - 0.5 * (hip_l + hip_r)) * forward, axis=1)


def _upright(motion: Motion, names: tuple[str, ...]) -> NDArray:
    """(F, K, 3) [m] landmarks in a world whose vertical axis is y."""
    return motion.positions(motion.body.landmarks.select(names)) @ rotation_between_up(motion.up, "y").T


def gait_numbers(motion: Motion, cycles: Cycles) -> dict[str, list[tuple[float, float]]]:
    """{what it is [unit]: (mean, standard deviation) of each side} of cycles.

    Of gait: stride time, cadence, stance, and, where the person moves on over ground, stride length and speed.
    """
    out: dict[str, list[tuple[float, float]]] = {}
    for side in cycles.sides:
        times = np.diff(motion.times[side.spans], axis=1).ravel()
        if cycles.kind != "gait":
            found = {"cycle time [s]": times}
        else:
            heel = _upright(motion, (f"{side.name[0]}_heel",))[:, 0, ::2]
            lengths = np.linalg.norm(heel[side.spans[:, 1]] - heel[side.spans[:, 0]], axis=1)
            found = {"stride time [s]": times, "cadence [steps/min]": 120 / times, "stance [% of cycle]": side.toe_off}
            if np.min(lengths) > _STEP * (motion.body.stature or 1.7):  # not on a treadmill, nor on the spot
                found |= {"stride length [m]": lengths, "speed [m/s]": lengths / times}
        for name, values in found.items():
            known = values[np.isfinite(values)]
            spread = float(known.std(ddof=1)) if len(known) > 1 else np.nan
            out.setdefault(name, []).append((float(known.mean()) if len(known) else np.nan, spread))
    return {name: values for name, values in out.items() if len(values) == len(cycles.sides)}


def _gait(motion: Motion) -> Cycles | None:
    ways = {side: foot_ahead(motion, side) for side in "lr"}
    if any(way is None for way in ways.values()):
        return None
    sides, alike, starts = [], [], {}
    for side, name in (("l", "left"), ("r", "right")):
        way = ways[side]
        assert way is not None
        smooth = _smoothed(way, motion.rate)
        least = _STEP * (motion.body.stature or 1.7)
        strikes = _peaks(smooth, least, round(_MIN_STRIDE_S * motion.rate))
        leaves = _peaks(-smooth, least, round(_MIN_STRIDE_S * motion.rate))
        starts[side] = strikes
        spans = _usable(motion, strikes)
        columns = [d for d, c in enumerate(motion.body.tree.coordinates) if c in [f"{g}_{side}" for g in _GAIT]]
        if len(spans) < 2 or not columns or not _even(spans):
            continue
        curves = normalised(np.unwrap(motion.angles[:, columns], axis=0), spans)
        alike.append(float(np.mean([likeness(curves[..., c]) for c in range(len(columns))])))
        sides.append(Side(name, spans, _toe_off(spans, leaves)))
    if not sides or min(alike) < _MIN_CORRELATION or not _alternate(starts["l"], starts["r"]):
        return None
    return Cycles("gait", tuple(sides), float(np.mean(alike)))


def _repeated(motion: Motion) -> Cycles | None:
    """Cycles between the peaks of the movement's main course: the first principal component of the angles seen."""
    seen = np.isfinite(motion.dof_std[:, 6:]).mean(axis=0) > 0.5
    angles = np.unwrap(motion.angles[:, seen & ~motion.body.tree.prismatic], axis=0)
    if not angles.size:
        return None
    centred = angles - angles.mean(axis=0)
    course = _smoothed(centred @ np.linalg.svd(centred, full_matrices=False)[2][0], motion.rate)
    extent = float(np.ptp(course))
    if extent < np.radians(20.0):  # all angles together: less is swaying or noise
        return None
    found = []
    for sign in (1.0, -1.0):  # from one extreme posture to the same again
        peaks = _peaks(sign * course, 0.5 * extent, round(_MIN_STRIDE_S * motion.rate))
        for starts in (peaks, peaks[::2], peaks[1::2]):  # a movement may come to its extreme twice in a cycle
            spans = _usable(motion, starts, longest=np.inf)
            if len(spans) >= 2 and _even(spans):
                found.append((likeness(normalised(angles, spans)), spans))
    if not found or max(found, key=lambda item: item[0])[0] < _MIN_CORRELATION:
        return None
    best = max(found, key=lambda item: (item[0], len(item[1])))
    return Cycles("repeated movement", (Side("both", best[1], np.zeros(0)),), best[0])


def _usable(motion: Motion, starts: NDArray, longest: float = _MAX_STRIDE_S) -> NDArray:
    spans = np.stack([starts[:-1], starts[1:]], axis=1) if len(starts) > 1 else np.zeros((0, 2), int)
    return np.array(
        [s for s in spans if s[1] - s[0] <= longest * motion.rate and np.all(motion.quality[s[0] : s[1] + 1] > 0)], int
    ).reshape(-1, 2)


def _even(spans: NDArray) -> bool:
    durations = np.diff(spans, axis=1).ravel()
    return bool(np.std(durations) <= _EVEN * np.mean(durations))


def _alternate(left: NDArray, right: NDArray) -> bool:
    """Whether the feet take turns: between two strikes of one foot lies one of the other, nowhere near the ends."""
    if not len(left) or not len(right):
        return False
    for one, other in ((left, right), (right, left)):
        for start, stop in pairwise(one):
            between = (other[(other > start) & (other < stop)] - start) / (stop - start)
            if len(between) != 1 or not 0.25 < between[0] < 0.75:
                return False
    return True


def _toe_off(spans: NDArray, leaves: NDArray) -> NDArray:
    out = np.full(len(spans), np.nan)
    for k, (start, stop) in enumerate(spans):
        within = leaves[(leaves > start) & (leaves < stop)]
        if len(within) == 1:
            out[k] = 100 * (within[0] - start) / (stop - start)
    return out


def _smoothed(values: NDArray, rate: float) -> NDArray:
    """Without what is faster than about 6 Hz (zero phase, a Gaussian): walking has 99 % of its power below (Winter)."""
    from scipy.ndimage import gaussian_filter1d

    sigma = rate / (2 * np.pi * 6.0) * np.sqrt(np.log(2.0))
    reach = min(int(np.ceil(4 * sigma)), len(values) - 1)
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, sigma)[reach : reach + len(values)])


def _peaks(values: NDArray, prominence: float, apart: int) -> NDArray:
    """Frames of the maxima that rise by `prominence` above the valleys to both sides; the higher of two that are near.

    The valley of a first or last peak may lie on one side only, but a peak is never the first or last frame.
    """
    from scipy.signal import find_peaks

    if np.ptp(values) < prominence:
        return np.empty(0, int)
    low = values.min() - prominence  # beyond the ends nothing is known: what lies there limits no peak
    tops = find_peaks([low, *values, low], prominence=prominence)[0] - 1
    kept: list[int] = []
    for k in tops[np.argsort(-values[tops], kind="stable")]:
        if 0 < k < len(values) - 1 and all(abs(k - other) >= apart for other in kept):
            kept.append(int(k))
    return np.array(sorted(kept), int)


COLUMNS = ("coordinate", "percent", "mean", "sd")

Norms = dict[str, NDArray]
"""{coordinate: (N, 3) percent of the cycle, mean [deg], standard deviation [deg]}, percent ascending."""


def read_norms(path: str | PathLike[str]) -> Norms:
    """Read normative values: a CSV with the columns coordinate, percent, mean and sd.

    A coordinate is named as in the tables of angles, with its side or, for both, without (`knee_angle`).

    Raises
    ------
    FileError
        The file is missing or no such table; the message names the line.
    """
    path = Path(path)
    remedy = "Give a CSV with the columns coordinate, percent (0 to 100), mean and sd (not negative) [deg]."
    names, values = read_table(path, COLUMNS[1:], remedy, text=COLUMNS[0])
    if not names:
        raise FileError("has no line of values", file=path, remedy=remedy)
    percent, _, sd = values.T
    wrong = ~(np.isfinite(values).all(axis=1) & (percent >= 0.0) & (percent <= 100.0) & (sd >= 0.0))
    if wrong.any():
        line = f"line {int(np.argmax(wrong)) + 2}"
        raise FileError("is no normative value", file=path, place=line, remedy=remedy)
    of = np.array(names)
    return {name: np.array(sorted(values[of == name].tolist())) for name in dict.fromkeys(names)}
