"""Contacts and toe-offs of real walks, straight and turning, against force plates and against the files' own events.

    python -m benchmarks gait gait_events

Every file is fitted by `kinefit markers fit` with its static trial and defaults. A plate's truth is where its vertical
force passes 20 N, of contacts that last a quarter of a second on one plate. The shares of the swing's speed that make
an event were chosen on the children HC002D, HC036A and HC050A, and on the plates of subject 4 and the sprinter of
`forces_nimblephysics`; the figures are of the others. Steps are compared with
the heels' markers at the same times. Events of the feet are those without plates; how many of the plates' the product
itself finds, with the right foot, is a figure of its own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import ended
from benchmarks.figures import amount, data, figure
from kinefit.bodies.motion import Motion
from kinefit.exporters.report.cycles import find_cycles, gait_numbers
from kinefit.exporters.report.feet import foot_events, footing
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers
from kinefit.readers.motion import read_motion

PRINTED = ("HC030A/straight", "HC030A/turn", "HC044A/straight", "HC044A/turn", "omcs")
CHOSEN = ("HC002D/straight", "HC002D/turn", "HC036A/straight", "HC036A/turn", "HC050A/straight", "HC050A/turn")
_FORCE_N, _PLATE_S, _LOADED_N = 20.0, 0.25, 200.0
_NEAR_S, _NEAR_M, _ENDS_S = 0.15, 0.2, 0.12
_SAME_S = 0.003  # of the plates' own events
_LABELS = {"Foot Strike": "contact", "Foot Off": "off"}


@dataclass(frozen=True)
class Event:
    """Of a foot ("l", "r"): "contact" or "off" at a time [s] of the file's clock."""

    foot: str
    kind: str
    time: float


def run() -> None:
    """Print the figures of the walks that were kept back, and of all how many have a record."""
    off: dict[tuple[str, str], list[tuple[float, float]]] = {}
    steps, records, plated = list[tuple[float, float]](), list[bool](), list[bool]()
    own: dict[str, list[tuple[float, float]]] = {"contact": [], "off": []}
    for name in (*PRINTED, *CHOSEN)[: amount(None, 1)]:
        path = file_of(name)
        if path is None:
            continue
        measured, markers = fitted(path), read_markers(path)
        motion = replace(measured, plates=())  # events of the feet alone
        cycles = find_cycles(motion)
        records.append(cycles is not None and cycles.kind == "gait")
        if name in CHOSEN:
            continue
        on_plates = plate_events(path, markers)
        for source, events in (("files", _own(markers)), ("plates", on_plates)):
            for event in events:
                off.setdefault((source, event.kind), []).append(missed(motion, event))
        for event in _own(markers):
            own[event.kind].append((_after_plate(event, on_plates), missed(motion, event)[0]))
        steps += _steps(motion, markers)
        steps_on_plates = found.steps if (found := footing(measured)) else ()
        found = [(step.side[0], time) for step in steps_on_plates for time in (step.contact, step.off)]
        plated += [
            any(side == event.foot and abs(time - event.time) < _SAME_S for side, time in found)
            for event in on_plates
        ]  # fmt: skip
    for kind, pairs in own.items():
        _print_laboratories(kind, 1e3 * np.array(pairs).reshape(-1, 2))
    for source in ("plates", "files"):
        for kind in ("contact", "off"):
            print_events(f"gait_{kind}_{source}", np.array(off.get((source, kind), [])).reshape(-1, 2))
    reason = "" if steps else "no recording"
    error, std = 1e3 * np.array(steps).reshape(-1, 2).T
    figure("gait_step_mm", float(np.sqrt(np.mean(np.square(error)))) if steps else None, "mm RMS", "<= 5", reason)
    print_held("gait_step", error, std, reason)
    figure("gait_plates_found", 100.0 * float(np.mean(plated)) if plated else None, "% of events", ">= 90", reason)
    figure("gait_records", 100.0 * float(np.mean(records)) if records else None, "% of files", ">= 100", reason)


def print_events(name: str, found: NDArray) -> None:
    """Mean and standard deviation of errors, and how many are within two of their own (N, 2) [s]."""
    known = found[np.isfinite(found[:, 0])]
    print(f"# {name}: {len(known)} of {len(found)} events found")
    reason = "" if len(known) else "no recording, or the package ezc3d is not installed"
    error, std = 1e3 * known.T if len(known) else (np.zeros(0), np.zeros(0))
    figure(f"{name}_mean", abs(float(error.mean())) if len(known) else None, "ms", "<= 8", reason)
    figure(f"{name}_sd", float(error.std()) if len(known) else None, "ms", "<= 12", reason)
    held = 100.0 * float(np.mean(np.abs(error) <= 2.0 * std)) if len(known) else None
    figure(f"{name}_held", held, "% within 2 sigma", ">= 90", reason)


def print_held(name: str, error: NDArray, std: NDArray, reason: str) -> None:
    """Share of errors (n,) within two of their standard deviations (n,): at least, and at most."""
    share = 100.0 * float(np.mean(np.abs(error) <= 2.0 * std)) if len(error) else None
    figure(f"{name}_held_least", share, "% within 2 sigma", ">= 90", reason)
    figure(f"{name}_held_most", share, "% within 2 sigma", "<= 98", reason)


def _after_plate(event: Event, on_plates: list[Event]) -> float:
    """[s] how much later an event is than the same one of a plate; NaN where there is none."""
    apart = (event.time - one.time for one in on_plates if (one.foot, one.kind) == (event.foot, event.kind))
    return next((time for time in apart if abs(time) < _NEAR_S), np.nan)


def _print_laboratories(kind: str, pairs: NDArray) -> None:
    """The files' own events against plates, and ours against them with a plate and without: pairs (N, 2) [ms]."""
    plated = np.isfinite(pairs[:, 0])
    groups = {"files after plates": pairs[plated, 0], "ours after files, on plates": pairs[plated, 1],
              "ours after files, elsewhere": pairs[~plated, 1]}  # fmt: skip
    for name, found in groups.items():
        if len(found):
            print(f"# {kind}, {name}: mean {found.mean():.1f} ms, sd {found.std():.1f} ms, {len(found)} events")


def file_of(name: str) -> Path | None:
    """A walk by its name; None where the recordings are not there."""
    if name == "omcs":
        folder = data("gait_omcs")
        return None if folder is None else next(folder.glob("*.c3d"))
    folder = data("gait_biomechzoo")
    return None if folder is None else folder / f"{name}.c3d"


def fitted(path: Path, mass: float | None = None) -> Motion:
    """The motion of a file of markers, of a person of a mass [kg]."""
    static = next((file for file in (path.parent / "static.c3d", path.parent / "static1.trc") if file.exists()), None)
    options = ["--static", str(static)] if static else []
    options += ["--mass", f"{mass}"] if mass else []
    with tempfile.TemporaryDirectory() as out:
        ended("markers", "fit", path, "-o", out, "--formats", "motion", *options, check=True)
        return read_motion(Path(out) / "motion.npz")


def _own(markers: Markers) -> list[Event]:
    """Events of the file, but for those next to its ends."""
    first, last = markers.times[0] + _ENDS_S, markers.times[-1] - _ENDS_S
    return [
        Event(e.context[:1].lower(), _LABELS[e.label], e.time)
        for e in markers.events if e.label in _LABELS and first < e.time < last
    ]  # fmt: skip


def plate_events(path: Path, markers: Markers) -> list[Event]:
    """Events by force plates under one foot."""
    out = []
    for times, forces, centre in plates_of(path):
        start, rate, force = float(times[0]), 1.0 / float(times[1] - times[0]), forces[2]
        count = round(_PLATE_S * rate)
        loaded = force > _FORCE_N
        for i in np.flatnonzero(np.diff(loaded.astype(int))):
            lands = bool(loaded[i + 1])
            stand = slice(i + 1, i + 1 + count) if lands else slice(max(i + 1 - count, 0), i + 1)
            if len(force[stand]) < count or loaded[stand].mean() < 0.8 or force[stand].max() < _LOADED_N:
                continue
            time = start + (i + 1) / rate
            middle = i + (count // 2 if lands else -count // 2)
            feet = dict(_feet_near(markers, start + middle / rate, centre[:2, middle]))
            foot = min(feet, key=lambda side: feet[side])
            if feet[foot] < _NEAR_M:
                out.append(Event(foot, "contact" if lands else "off", time))
    return out


def plates_of(path: Path) -> list[tuple[NDArray, NDArray, NDArray]]:
    """Of each plate of a file: times (N,) [s], force (3, N) [N] on the person, z up, and its centre (3, N) [m]."""
    try:
        import ezc3d
    except ImportError:
        return []
    read, out = ezc3d.c3d(str(path), extract_forceplat_data=True), []
    rate, start = read["header"]["analogs"]["frame_rate"], float(read_markers(path).times[0])
    for plate in read["data"]["platform"]:
        force = np.array(plate["force"])
        force *= 1.0 if force[2].max() > -force[2].min() else -1.0
        low = force[2] < np.quantile(force[2], 0.3) + 5.0
        force -= np.median(force[:, low], axis=1, keepdims=True) * (np.median(force[2, low]) < _LOADED_N)
        out.append((start + np.arange(force.shape[1]) / rate, force, 0.001 * np.array(plate["center_of_pressure"])))
    return out


def _feet_near(markers: Markers, time: float, centre: NDArray) -> Iterator[tuple[str, float]]:
    """(foot, [m] from a plate's centre of pressure (2,) at a time)."""
    frame = int(np.argmin(np.abs(markers.times - time)))
    for side in "lr":
        points = [markers.positions[frame, _index(markers, f"{side.upper()}{end}"), :2] for end in ("HEE", "TOE")]
        yield side, float(np.linalg.norm(np.nanmean(points, axis=0) - centre))


def _index(markers: Markers, label: str) -> int:
    return next(i for i, name in enumerate(markers.names) if name.rpartition(":")[2] == label)


def missed(motion: Motion, event: Event) -> tuple[float, float]:
    """[s] how much later the motion has an event, with the standard deviation that it says; NaN without one near."""
    feet = foot_events(motion)
    foot = feet and (feet.left if event.foot == "l" else feet.right)
    times, stds = (foot.contacts, foot.contact_std) if event.kind == "contact" else (foot.offs, foot.off_std)
    near = int(np.argmin(np.abs(times - event.time))) if len(times) else -1
    found = near >= 0 and abs(times[near] - event.time) < _NEAR_S
    return (float(times[near] - event.time), float(stds[near])) if found else (np.nan, np.nan)


def _steps(motion: Motion, markers: Markers) -> list[tuple[float, float]]:
    """[m] how much longer every step is than by the heels' markers at the same times, and its standard deviation."""
    cycles = find_cycles(motion)
    if cycles is None or cycles.feet is None:
        return []
    lengths, out = gait_numbers(motion, cycles)["step length [m]"], []
    feet = {"left": cycles.feet.left, "right": cycles.feet.right}

    def heel(side: str, time: float) -> NDArray:
        frame = int(np.argmin(np.abs(markers.times - time)))
        return np.asarray(markers.positions[frame, _index(markers, f"{side[0].upper()}HEE"), :2])

    for side, quantity in zip(cycles.sides, lengths, strict=True):
        opposite = "right" if side.name == "left" else "left"
        for (start, stop), length, std in zip(side.times, quantity.values, quantity.stds, strict=True):
            landed = feet[opposite].contacts
            landed = landed[(landed > start) & (landed < stop)]
            if len(landed) == 1:
                later = 0.1 * (stop - start)  # as the record has it
                begin, end = (heel(side.name, time + later) for time in (start, stop))
                middle = heel(opposite, landed[0] + later)
                along = (end - begin) / np.linalg.norm(end - begin)
                out.append((length - float((end - middle) @ along), std))
    return [pair for pair in out if np.isfinite(pair[0])]
