"""Figures of marker models and of the label audit, on real takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import NotMeasured, amount, data, each, figure
from benchmarks.scenes.marker_takes import put_right
from benchmarks.timing import timed, took
from kinefit.bodies.marker_sets import find_marker_set
from kinefit.markers.audit.audit import audit_take
from kinefit.markers.model.learn import learn_model, training_gate
from kinefit.markers.model.model import MarkerModel
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers

# Takes of bodies or legs, of nine marker sets, in which no exchanged labels are known but those of `MISNAMED`, which
# `clean` puts right (some have strays: RFHD in 01_01, toes in 85_12). Thresholds were chosen on swaps injected, with
# other seeds, into the CMU, HDM05, ARIEL, Stanford.
CLEAN = (
    "markers/mocaprecovery/data__85_12.c3d", "markers/mocaprecovery/data__HDM_mm_01-02_03_120.c3d",
    "markers/c3d_to_xyz/01_01.c3d", "markers/momentum/momentum__examples__process_markers_app__02_01.c3d",
    "markers/nimblephysics/data__c3d__squat.c3d", "markers/nimblephysics/data__c3d__JA1Gait35.c3d",
    "markers/nimblephysics/data__grf__Subject4__MarkerData__static1.trc",
    "markers/nimblephysics/data__grf__Subject4__MarkerData__squats1.trc",
    "markers/nimblephysics/data__grf__Subject4__MarkerData__DJ1.trc",
    "markers/nimblephysics/data__grf__Subject4__MarkerData__walking1.trc",
    "markers/nimblephysics/data__osim__HamnerSubject04__subject04__trials__run200__markers.trc",
    "markers/nimblephysics/data__osim__WeirdFormatTests__markers.trc",
    "markers/opensim/Pipelines__Rajagopal__ExpData__motion_capture_walk.trc",
    "markers/btkdata/Input__C3DSamples__c3d.org__sample01__Eb015pr.c3d",
    "markers_pycgm/Test_Files/Movement_trial.c3d", "markers_bmc_run/walk1.trc",
)  # fmt: skip
_STANFORD = "forces_nimblephysics/subject4/%s.trc"
_THIGH = {"r_thigh3", "r_thigh5"}
WRONG: dict[str, list[set[str]]] = {
    "markers/nimblephysics/data__c3d__nick_freeform_001.c3d": [
        {"Nick01:LIWR", "Nick01:LOHAND"}, {"Nick01:RTOE", "Nick01:RIWR"},
    ],
    "markers_bmc_run/run/ExpData/motion_capture_run.trc": [{"RTOE", "RMT5"}],
    _STANFORD % "DJ1": [{"r_5meta", "r_toe"}],
    _STANFORD % "walking1": [_THIGH],
    _STANFORD % "walking2": [_THIGH],
    _STANFORD % "walkingTO1": [_THIGH, {"L_thigh2", "L_thigh4"}],
    _STANFORD % "walkingTS1": [_THIGH],
}  # fmt: skip
"""Labels that are exchanged in takes as they were published, with nothing else: RTOE and RMT5 every third frame, those
of the Stanford takes for one frame at the end of a gap, 1 to 5 mm from the other's place and 53 to 111 mm from their
own; for the others see `MISNAMED`."""

FLIP = "markers/nimblephysics/data__osim__DetectMarkerFlip__squats1.trc"
SUBJECT4 = "markers/nimblephysics/data__grf__Subject4__MarkerData__squats1.trc"
SWAPS = amount(6, 1)
"""Injected in each take, one at a time: two within a segment, two left for right, two that are near each other."""


def take(name: str) -> Markers | None:
    """A take by its place below the recordings."""
    folder, _, rest = name.partition("/")
    root = data(folder)
    return read_markers(root / rest) if root is not None and (root / rest).exists() else None


def clean(name: str) -> Markers | None:
    """One of the takes in which no labels are exchanged."""
    markers = take(name)
    if markers is None:
        return None
    return replace(markers, positions=put_right(markers, name.removeprefix("markers/")), residual=None)


def injected(
    markers: Markers, model: MarkerModel, rng: np.random.Generator
) -> Iterator[tuple[Markers, set[str], int, int]]:
    """The take with two labels exchanged over 5 to 200 frames: take, the labels, first and last frame."""
    frames, column = len(markers), [markers.names.index(n) for n in model.labels]
    for number in range(SWAPS):
        length = min(frames // 3, int(rng.integers(5, 200)))
        first = int(rng.integers(0, frames - length))
        span = slice(first, first + length)
        at = markers.positions[span][:, column]
        whole = np.flatnonzero(np.isfinite(at[..., 0]).mean(0) > 0.5)
        if number % 3 == 0:
            members = [m for m in model.segments[rng.integers(len(model.segments))] if m in whole]
            if len(members) < 2:
                continue
            a, b = rng.choice(members, 2, replace=False)
        else:
            a = int(rng.choice(whole))
            label = model.labels[a].rpartition(":")[2]
            other = {"L": "R", "R": "L", "l": "r", "r": "l"}.get(label[0], "") + label[1:]
            twins = [m for m in whole if model.labels[m].rpartition(":")[2].lower() == other.lower() and m != a]
            if number % 3 == 1 and twins:
                b = twins[0]
            else:
                apart = np.nanmedian(np.linalg.norm(at[:, whole] - at[:, a, None], axis=-1), axis=0)
                b = int(rng.choice([m for m in whole[np.argsort(apart)] if m != a][:3]))
        positions = np.array(markers.positions)
        positions[span, column[a]], positions[span, column[b]] = at[:, b], at[:, a]
        pair = {model.labels[a], model.labels[b]}
        yield replace(markers, positions=positions, residual=None), pair, first, first + length - 1


def run() -> None:
    """Print the figures; three minutes on one core."""
    rng = np.random.default_rng(5)
    alarms = hits = tried = false = takes = 0
    seconds = []
    for name in CLEAN[: amount(None, 1)]:
        markers = clean(name)
        if markers is None:
            continue
        takes += 1
        with timed(seconds):
            before = audit_take(markers)
        alarms += sum(f.kind in ("swapped", "throughout") for f in before)
        for wrong, pair, first, last in injected(markers, learn_model(markers), rng):
            found = [f for f in audit_take(wrong) if f.kind in ("swapped", "throughout")]
            right = [f for f in found if set(f.labels) == pair and abs(f.first - first) + abs(f.last - last) <= 4]
            tried, hits, false = tried + 1, hits + bool(right), false + len(found) - len(right)
    why = "" if takes else "no recordings: set KINEFIT_DATA"
    figure("audit_false_alarms_clean", alarms if takes else None, f"swaps in {takes} takes", "== 0", why)
    figure("audit_injected_swaps_found", 100 * hits / tried if tried else None, "%", ">= 95", why)
    figure("audit_injected_swaps_wrong", 100 * false / tried if tried else None, "%", "<= 1", why)
    figure("audit_seconds_take", float(np.median(seconds)) if seconds else None, "s CPU", "<= 5", why)
    for name, pairs in WRONG.items():
        markers = take(name)
        found = [set(f.labels) for f in audit_take(markers) if f.kind == "swapped"] if markers else []
        value = float(all(pair in found for pair in pairs) and all(pair in pairs for pair in found))
        title = f"audit_real_{name.rpartition('/')[2].partition('.')[0]}"
        figure(title, value if markers else None, "found", "== 1", why)
    one_frame()
    in_gaps()
    each(gappy)
    flip, subject4 = take(FLIP), take(SUBJECT4)
    found = audit_take(flip, model=learn_model(subject4)) if flip and subject4 else []
    for f in found:
        print(f"  {f.kind}: {f}")
    # Missed for a reason: no two names are exchanged in this take. Its humerus and forearm markers, where it differs
    # most from Subject4, keep their distances to shoulder and wrist within 11 mm: they are worn elsewhere.
    swaps = sum(f.kind in ("swapped", "throughout") for f in found)
    figure("audit_flip_against_subject4", swaps if flip and subject4 else None, "swaps", ">= 1", why)
    poor = take("markers/momentum/momentum__examples__process_markers_app__02_01.c3d")
    if poor is not None:
        held_still = {f.name for f in training_gate(poor, learn_model(poor)) if f.kind == "still"}
        figure("gate_walk_wrists_waist_neck", len(held_still & {"hand_r", "hand_l", "pelvis", "head"}), "of 4", "== 4")
    calibration()


def two_near(x: NDArray, rng: np.random.Generator) -> tuple[int, int, int]:
    """A frame of a take (F, M, 3) and two labels that are seen about it, one of the six nearest to the other."""
    f = int(rng.integers(5, len(x) - 5))
    seen = np.flatnonzero(np.isfinite(x[f - 2 : f + 3, :, 0]).all(0))
    a = int(rng.choice(seen))
    return f, a, int(seen[rng.choice(np.argsort(np.linalg.norm(x[f, seen] - x[f, a], axis=-1))[1:7])])


def is_named(wrong: Markers, f: int, a: int, b: int) -> bool:
    """Whether the audit names two exchanged columns, to two frames."""
    pair = {wrong.names[a], wrong.names[b]}
    return any({*g.labels} == pair and abs(g.first - f) + abs(g.last - f) <= 2 for g in audit_take(wrong))


def one_frame() -> None:
    """Two labels exchanged for one frame, near each other, with both seen or one hidden: four of each in every take."""
    rng = np.random.default_rng(3)
    tried = hits = 0
    for name in CLEAN[: amount(None, 1)]:
        markers = clean(name)
        if markers is None:
            continue
        column = [markers.names.index(n) for n in learn_model(markers).labels]
        x = markers.positions[:, column]
        for hidden in (False, True) * amount(4, 1):
            f, a, b = two_near(x, rng)
            positions = np.array(markers.positions)
            positions[f, column[a]], positions[f, column[b]] = x[f, b], x[f, a] if not hidden else np.nan
            hits += is_named(replace(markers, positions=positions, residual=None), f, column[a], column[b])
            tried += 1
    why = "" if tried else "no recordings: set KINEFIT_DATA"
    figure("audit_one_frame_exchanges", 100 * hits / tried if tried else None, "% found", ">= 98", why)


def in_gaps() -> None:
    """Two labels exchanged for one frame inside a gap or at its end, in five ways, twice each in every take.

    Gaps are of 1 to 30 frames before and after that frame.
    """
    ways = (  # who is hidden: a before, b before and after, a after; the label that is not seen in that frame
        ("both are seen in that frame alone", True, True, True, False),
        ("one is seen in that frame alone", True, False, True, False),
        ("one is seen in that frame alone, the other not at all", True, True, True, True),
        ("one goes with that frame, the other comes after it", False, True, True, True),
        ("one leaps there, the other is hidden", False, True, False, True),
    )
    rng, tried, hits = np.random.default_rng(11), 0, np.zeros(len(ways), int)
    for name in CLEAN[: amount(None, 1)]:
        markers = clean(name)
        if markers is None:
            continue
        column = [markers.names.index(n) for n in learn_model(markers).labels]
        x = markers.positions[:, column]
        for way, (_, a_before, b_around, a_after, hidden) in [*enumerate(ways)] * amount(2, 1):
            f, a, b = two_near(x, rng)
            low, high = f - rng.integers(1, 31, 2).clip(max=f), f + rng.integers(1, 31, 2)
            y = np.array(x)
            for k, first, last in ((a, low[0] if a_before else f, high[0] if a_after else f), (b, low[1], high[1])):
                if k == a or b_around:
                    y[first : last + 1, k] = np.nan
            y[f, a], y[f, b] = x[f, b], np.nan if hidden else x[f, a]
            positions = np.array(markers.positions)
            positions[:, column] = y
            hits[way] += is_named(replace(markers, positions=positions), f, column[a], column[b])
        tried += amount(2, 1)
    for (what, *_), count in zip(ways, hits):
        print(f"# exchanges in gaps, {what}: {count} of {tried}")
    why = "" if tried else "no recordings: set KINEFIT_DATA"
    share = 100 * float(hits.sum()) / (len(ways) * tried) if tried else None
    figure("audit_one_frame_exchanges_in_gaps", share, "% found", ">= 98", why)


def gappy() -> None:
    """Time of the longest take with forty gaps of 1 to 30 frames a marker and fifteen exchanges of 5 to 200 frames."""
    markers, rng = clean(CLEAN[0]), np.random.default_rng(0)
    if markers is None:
        raise NotMeasured("no recordings: set KINEFIT_DATA")
    x = np.array(markers.positions)
    for k in range(x.shape[1]):
        for _ in range(40):
            f = int(rng.integers(len(x)))
            x[f : f + rng.integers(1, 30), k] = np.nan
    for _ in range(15):
        (a, b), f = rng.choice(x.shape[1], 2, replace=False), int(rng.integers(len(x) - 200))
        n = int(rng.integers(5, 200))
        x[f : f + n, [a, b]] = x[f : f + n, [b, a]]
    found, seconds = took(lambda: audit_take(replace(markers, positions=x, residual=None)))
    figure("audit_seconds_gaps_and_swaps", seconds, "s CPU", "<= 5")
    print(f"# {sum(f.kind == 'swapped' for f in found)} exchanges reported of 15 injected into gaps")


def calibration() -> None:
    """Whether distances stay within what a model of other frames says: share beyond three deviations, in segments."""
    for title, name, share in (
        ("half", "markers/mocaprecovery/data__HDM_mm_01-02_03_120.c3d", 0.5),
        ("twentieth", "markers/c3d_to_xyz/01_01.c3d", 0.05),
    ):
        markers = take(name)
        if markers is None or find_marker_set(markers.names) is None:
            figure(f"model_beyond_3_deviations_{title}", None, "%", "<= 8", "no recordings: set KINEFIT_DATA")
            continue
        cut = int(share * len(markers))
        model = learn_model(replace(markers, positions=markers.positions[:cut], residual=None))
        column = [markers.names.index(n) for n in model.labels]
        rest = markers.positions[cut :: max(1, len(markers) // 300)][:, column]
        d = np.linalg.norm(rest[:, :, None] - rest[:, None], axis=-1)
        inside = np.zeros((len(model), len(model)), bool)
        for members in model.segments:
            inside[np.ix_(members, members)] = True
        np.fill_diagonal(inside, False)
        z = (np.abs(d - model.mean) / np.maximum(model.deviation, 1e-6))[:, inside]
        z = z[np.isfinite(z)]
        figure(f"model_beyond_3_deviations_{title}", 100 * float((z > 3).mean()), "%", "<= 8")
