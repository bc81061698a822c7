"""Feet on force plates: whose step a plate measured, when it began and ended, and what is wrong with a plate.

A step counts where one foot stands wholly on a plate, or on plates together, and the other does not touch them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.masses import segment_masses
from kinefit.bodies.motion import Motion
from kinefit.findings import Finding, listed
from kinefit.geometry.force_plates import LEAST_LOAD, ForcePlate, total_load
from kinefit.observations import Markers

FOOT = "heel", "metatarsal_phalanx_1", "metatarsal_phalanx_5"
"""Landmarks of a foot, after "l_" or "r_"."""

GRAVITY = 9.81
"""[m/s²]"""

Events = Sequence[tuple[NDArray, NDArray]]
"""Contacts (N,) and toe-offs (M,) [s] of the left and of the right foot."""

_Late = tuple[float, float, int]

CONTACT_STD_S = 0.003
"""[s] that a load takes to rise to 20 N at the 5 to 10 kN/s of a heel."""

_MIN_STEP_S, _MIN_PEAK = 0.1, 40.0  # [s], [N]: shorter or lighter, it is no step
_MAX_OFF = 0.12  # [m] of the centre of pressure from the line between heel and ball: half a foot's width and its toes
_WHOLE_SHARE = 0.9  # of the time, and of a foot's points, over a plate
_NEARER = 0.05  # [m] by which the other foot is farther away, so that it is known whose step it is
_EDGE = 0.03  # [m] beyond a plate's edge: the skin and errors of landmarks
_MOVING, _STANDING_SHARE = 0.5, 0.2  # [m/s] of a foot that swings past the other; of the time, in which it stands
_STANDING_M = 0.15  # above a plate, at most: markers of a foot that stands on it
_PARTLY = "a foot stands partly off it"
_MIN_OFFSET, _MAX_CORRECTED = 0.06, 0.04  # [m] from the foot in the median: surely wrong; right once it is corrected
_FOOT_OFFSET = 0.3  # [m]: about a foot's length away from it, somebody or something else stands there
_CORRECTED_SHARE = 0.4  # of the distance before, once it is corrected
_SAME_S = 0.12  # [s] between an event of a plate and that of the motion which is the same
_STRIDE_S = 0.4  # [s] from an event to the next one of its kind and foot, at least: sprinters take 0.45 s
_LATE_S, _MAX_SPREAD_S = 0.05, 0.03  # [s]: events by the feet's speed are right to 12 ms
_STAND_S, _STEADY, _DOUBT = 0.5, 0.02, 2.0  # [s] of standing still, as the relative deviation of the load says; sigmas
_LOADS = 0.45, 12.0  # [body weights] of the largest load: a step that is not whole, a landing


@dataclass(frozen=True, eq=False)
class Footfall:
    """A foot on a plate.

    Parameters
    ----------
    plate : name
    side : "left" or "right"
    contact, off : [s] when the load rises above 20 N and falls below; NaN where the record begins or ends under load
    """

    plate: str
    side: str
    contact: float
    off: float


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A time in which somebody stands on a plate: samples [first, stop), and where the feet then are.

    Parameters
    ----------
    cop : (n, 2) [m] centre of pressure along the plate's axes, from its centre, at samples of 100 N or more
    full : (n,) bool, samples of half the largest load
    feet : (n, 2, 3, 2) [m] heel and ball landmarks of both feet, likewise; speeds : (n, 2, 3) [m/s] over the ground
    """

    plate: ForcePlate
    first: int
    stop: int
    cop: NDArray
    full: NDArray
    feet: NDArray
    speeds: NDArray

    @property
    def span(self) -> tuple[float, float]:
        """[s] of the first and of the last sample."""
        return float(self.plate.times[self.first]), float(self.plate.times[self.stop - 1])

    @property
    def offsets(self) -> NDArray:
        """(n, 2, 2) [m] from the nearest point of the line from heel to ball of each foot to the centre of pressure."""
        return self.offsets_of(self.cop)

    def offsets_of(self, cop: NDArray) -> NDArray:
        """As `offsets`, of another centre of pressure (n, 2)."""
        heel, ball = self.feet[:, :, 0], self.feet[:, :, 1:].mean(axis=2)
        way = ball - heel
        along = np.sum((cop[:, None] - heel) * way, axis=-1) / np.maximum(np.sum(way * way, axis=-1), 1e-9)
        return cop[:, None] - heel - np.clip(along, 0.0, 1.3)[..., None] * way  # toes are ahead of the ball

    @property
    def half(self) -> NDArray:
        """(2,) [m] from the middle of the plate to just beyond its edges."""
        return 0.5 * np.ptp((self.plate.corners - self.plate.centre) @ self.plate.axes.T, axis=0) + _EDGE

    @property
    def apart(self) -> NDArray:
        """(2,) [m] from the line of each foot to the centre of pressure, the median under full load."""
        return np.asarray(np.median(np.linalg.norm(self.offsets, axis=-1)[self.full], axis=0))

    def is_over(self, side: int) -> NDArray:
        """(k, 3) bool: points of a foot that are over the plate, under full load."""
        return np.asarray(np.all(np.abs(self.feet[self.full, side]) < self.half, axis=-1))

    def is_stood_on(self, side: int) -> bool:
        """Whether a foot stands over the plate for a fifth of the time or more."""
        stands = self.is_over(side) & (self.speeds[self.full, side] < _MOVING)
        return bool(stands.any(axis=1).mean() > _STANDING_SHARE)

    def time_of(self, end: int) -> float:
        """[s] when the load crosses 20 N at one end of the samples; NaN at the ends of the record."""
        load = self.plate.load
        if not 0 < end < len(load):
            return np.nan
        a, b = load[end - 1], load[end]
        return float(self.plate.times[end - 1] + (LEAST_LOAD - a) / (b - a) / self.plate.rate)


def feet_on_plates(motion: Motion, events: Events, belt: NDArray) -> tuple[list[Footfall], list[Finding]]:
    """Steps of one foot alone on a plate, or on several plates, in the order of their contacts; what is wrong.

    That is plates that are moved, turned, late or of another unit, as the feet and the load tell, and loads of no
    single foot. A plate whose clock is not that of the motion has no steps.

    Parameters
    ----------
    motion : Motion
    events : of the feet alone, as their motion shows them
    belt : (3,) [m/s] of the ground in the motion's world; zero of a floor
    """
    loaded = list(_loaded(motion, belt))
    late, (steps, others) = _lateness(loaded, events), _footfalls(loaded)
    weight = GRAVITY * float(segment_masses(motion.body).masses.sum())
    findings = _plate_findings(motion, loaded, late, weight) if loaded else []
    return ([] if late else steps), findings or _of_no_foot(others, weight)


def _footfalls(loaded: Sequence[_Loaded]) -> tuple[list[Footfall], list[tuple[_Loaded, str]]]:
    """Steps, and the loads that are none, with the reason."""
    steps, others = list[tuple[int, list[_Loaded]]](), list[tuple[_Loaded, str]]()
    for one in sorted(loaded, key=lambda one: one.span):
        if isinstance(side := _side(one), str):
            others.append((one, side))
        elif same := [parts for s, parts in steps if s == side and one.span[0] <= max(p.span[1] for p in parts)]:
            same[0].append(one)
        else:
            steps.append((side, [one]))
    whole = [_is_whole(side, parts) for side, parts in steps]
    others += [(one, _PARTLY) for (_, parts), good in zip(steps, whole) if not good for one in parts]
    return [_footfall(side, parts) for (side, parts), good in zip(steps, whole) if good], others


def _of_no_foot(others: Sequence[tuple[_Loaded, str]], weight: float) -> list[Finding]:
    """One note for each plate on loads, as those of a step, that are of no single foot; `weight` [N]."""
    said: dict[str, list[str]] = {}
    for one, why in sorted(others, key=lambda pair: pair[0].span):
        if one.plate.load[one.first : one.stop].max() > _LOADS[0] * weight:
            said.setdefault(one.plate.name, []).append(f"from {one.span[0]:.2f} to {one.span[1]:.2f} s ({why})")
    text = "The force on {} is given to no foot {}. Contacts and toe-offs there are those of the feet."
    return [Finding("note", "plates", text.format(name, listed(times, 6))) for name, times in said.items()]


def _is_whole(side: int, parts: Sequence[_Loaded]) -> bool:
    """Whether every point of a foot is over one of the plates that it loads."""
    if len(parts) == 1:
        return bool(parts[0].is_over(side).mean() > _WHOLE_SHARE)
    over = [one.is_over(side).mean(axis=0) for one in parts]  # of each plate, by point
    return bool(np.max(over, axis=0).min() > _WHOLE_SHARE)


def _footfall(side: int, parts: Sequence[_Loaded]) -> Footfall:
    """A step of loads in the order of their begin, with its first contact and its last toe-off."""
    last = max(parts, key=lambda one: one.span[1])
    names = ", ".join(dict.fromkeys(one.plate.name for one in parts))
    return Footfall(names, ("left", "right")[side], parts[0].time_of(parts[0].first), last.time_of(last.stop))


def _side(one: _Loaded) -> int | str:
    """0 for the left foot, 1 for the right one; the reason where it is not sure, or not alone."""
    apart, side = one.apart, int(np.argmin(one.apart))
    stands = [one.is_stood_on(foot) for foot in (side, 1 - side)]
    if all(stands):
        return "both feet stand there"
    if np.linalg.norm(one.offsets[:, side], axis=-1).max() > _MAX_OFF:
        return "it is not under one foot throughout: somebody or something else loads the plate"
    return "both feet are near" if stands[1] or apart[1 - side] < apart[side] + _NEARER else side


def _loaded(motion: Motion, belt: NDArray) -> Iterator[_Loaded]:
    """All times in which somebody stands on a plate while the body is known; `belt` (3,) [m/s] of the ground."""
    names = [f"{side}_{name}" for side in "lr" for name in FOOT]
    if not motion.plates or len(motion) < 2 or any(name not in motion.body.landmarks.names for name in names):
        return
    points = motion.positions(motion.body.landmarks.select(tuple(names)))
    speeds = np.linalg.norm(np.gradient(points, 1.0 / motion.rate, axis=0) - belt, axis=-1)
    table = np.concatenate([points.reshape(len(points), -1), speeds], axis=1)
    for plate in motion.plates:
        load, times = plate.load, plate.times
        edges = np.flatnonzero(np.diff(np.concatenate([[False], load >= LEAST_LOAD, [False]]).astype(int)))
        cop = (plate.centre_of_pressure() - plate.centre) @ plate.axes.T
        for first, stop in edges.reshape(-1, 2):
            most = load[first:stop].max()
            used = first + np.flatnonzero(load[first:stop] > min(5.0 * LEAST_LOAD, 0.5 * most))
            used = used[(times[used] >= motion.times[0]) & (times[used] <= motion.times[-1])]
            full = load[used] > 0.5 * most
            if (stop - first) / plate.rate < _MIN_STEP_S or most < _MIN_PEAK or not full.any():
                continue
            now = np.column_stack([np.interp(times[used], motion.times, column) for column in table.T])
            at = (now[:, :18].reshape(-1, 2, 3, 3) - plate.centre) @ plate.axes.T
            yield _Loaded(plate, int(first), int(stop), cop[used], full, at, now[:, 18:].reshape(-1, 2, 3))


def standing_mass(trials: Sequence[Sequence[ForcePlate]], body: Body) -> float | None:
    """[kg] of a person who stands still with all weight on plates in the first trial that shows it; None without one.

    Plates of each trial. The load is steady to 2 % for half a second or more, and the mass is one that people of the
    stature have, within two standard deviations. Who stands on plates with one of two feet is lighter than most.
    """
    return next((mass for plates in trials if plates and (mass := _standing(plates, body))), None)


def _standing(plates: Sequence[ForcePlate], body: Body) -> float | None:
    first = min(plates, key=lambda plate: plate.first_time)
    total = total_load(plates, first.times)
    count = round(_STAND_S * first.rate)
    if len(total) < count:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(total, count)[:: max(count // 10, 1)]
    mean, std = windows.mean(axis=1), windows.std(axis=1)
    steady = mean[(std < _STEADY * mean) & (mean > LEAST_LOAD)]
    expected = segment_masses(body)
    found = float(np.median(steady)) / GRAVITY if len(steady) else 0.0
    return found if found and abs(found - expected.masses.sum()) < _DOUBT * expected.std else None


def by_plates(steps: Sequence[Footfall], side: str, end: str, times: NDArray, stds: NDArray) -> tuple[NDArray, NDArray]:
    """Events of a foot with those that a plate measured in place of the motion's, and others that it alone shows.

    Parameters
    ----------
    steps : as `feet_on_plates` finds them
    side : "left" or "right"; end : "contact" or "off"
    times, stds : (N,) [s] of the motion

    Returns
    -------
    times, stds : (M,) [s], in increasing order
    """
    ends = [getattr(step, end) for step in steps if step.side == side]
    found = [(time, CONTACT_STD_S) for time in ends if np.isfinite(time)]
    nearest = [float(np.min(np.abs(times - time), initial=np.inf)) for time, _ in found]
    found = [pair for pair, off in zip(found, nearest) if off <= _SAME_S or off >= _STRIDE_S]
    kept = [pair for pair in zip(times, stds) if all(abs(pair[0] - time) > _SAME_S for time, _ in found)]
    table = np.array(sorted([*kept, *found])).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _lateness(loaded: Sequence[_Loaded], events: Events) -> _Late | None:
    """[s] by which the plates' clock is late, its deviation and the number of events; None if it is right."""
    late = np.array([off for one in loaded for off in _late_events(one, events)])
    spread = 1.48 * float(np.median(np.abs(late - np.median(late)))) if len(late) else np.inf
    if len(late) < 2 or abs(np.median(late)) < _LATE_S or spread > _MAX_SPREAD_S:
        return None
    return float(np.median(late)), max(spread, 0.012) / float(np.sqrt(len(late))), len(late)


def _plate_findings(motion: Motion, loaded: Sequence[_Loaded], late: _Late | None, weight: float) -> list[Finding]:
    """What is wrong with plates: moved, turned, of another unit or late; `weight` [N]."""
    out = list[Finding]()
    peak = float(total_load(motion.plates, loaded[0].plate.times).max()) / weight
    if not _LOADS[0] < peak < _LOADS[1] and len(loaded) > 1:
        text = f"The largest load on the plates is {peak:.2g} body weights: their forces are not in newtons."
        out.append(_finding(text, "Likely; a person who only touches them does the same.", "ANALOG:UNITS or SCALE"))
    else:
        for plate in motion.plates:
            own = [one for one in loaded if one.plate is plate]
            text, confidence = _misplaced(own) if own else ("", "")
            out += [_finding(text, confidence, "CORNERS, or shift and turn of its [[plate]]")] * bool(text)
    if late is not None:
        apart = f"{late[0]:+.3f} ± {late[1]:.3f} s"
        text = f"The plates' clock is {apart} off that of the motion: no event is taken of them."
        out.append(_finding(text, f"Likely, by {late[2]} contacts and toe-offs.", "time_offset of its [[plate]]"))
    return out


def _late_events(one: _Loaded, events: Events) -> Iterator[float]:
    """[s] from the nearest events of the foot that stands on a plate to those of its load."""
    if one.apart.min() < _MAX_OFF:
        for end, times in zip((one.first, one.stop), events[int(np.argmin(one.apart))]):
            if len(times) and np.isfinite(time := one.time_of(end)):
                yield float(min(time - times, key=abs))


def _finding(text: str, confidence: str, what: str) -> Finding:
    return Finding("doubt", "plates", text, (), confidence, f"Correct {what}.")


def stood_on(motion: Motion, others: Sequence[Markers]) -> tuple[tuple[ForcePlate, ...], list[Finding]]:
    """The plates that this person of a recording loads alone, and notes on those on which another stands, too.

    `others`: markers of the other people, in the motion's world and by its clock.
    """
    loaded = [one for one in _loaded(motion, np.zeros(3)) if one.is_stood_on(0) or one.is_stood_on(1)]
    shared = dict.fromkeys(one.plate.name for one in loaded if any(_is_shared(one, other) for other in others))
    own = {one.plate.name for one in loaded} - shared.keys()
    text = "The force on {} is assigned to no person: another person stands there at the same time."
    notes = [Finding("note", "plates", text.format(name)) for name in shared]
    return tuple(plate for plate in motion.plates if plate.name in own), notes


def _is_shared(one: _Loaded, other: Markers) -> bool:
    """Whether markers of another person stay low over a plate for a fifth of the time that it is loaded."""
    x = other.positions - one.plate.centre
    slow = np.linalg.norm(np.gradient(x, 1.0 / other.rate, axis=0), axis=-1) < _MOVING
    low = slow & np.all(np.abs(x @ one.plate.axes.T) < one.half, axis=-1) & (np.abs(x @ one.plate.normal) < _STANDING_M)
    during = (other.times >= one.span[0]) & (other.times <= one.span[1])
    return bool(during.any() and low[during].any(axis=1).mean() > _STANDING_SHARE)


def _misplaced(own: list[_Loaded]) -> tuple[str, str]:
    """How a plate differs from its stated place, and how certain that is; empty where it does not."""
    turns = {"turned by 180 degrees": (-1, -1), "mirrored along x": (-1, 1), "mirrored along y": (1, -1)}
    nearest = lambda one, cop: min(np.moveaxis(one.offsets_of(cop), 1, 0), key=lambda e: np.median(np.hypot(*e.T)))
    distance = lambda offsets: float(np.median(np.hypot(*np.concatenate(offsets).T)))
    as_said = [nearest(one, one.cop) for one in own]
    before = distance(as_said)
    if before < _MIN_OFFSET:
        return "", ""
    shift = np.median(np.concatenate(as_said), axis=0)
    found = {how: distance([nearest(one, one.cop * signs) for one in own]) for how, signs in turns.items()}
    found[f"shifted by {100 * np.hypot(*shift):.0f} cm"] = distance([nearest(one, one.cop - shift) for one in own])
    good = [how for how, after in found.items() if after < min(_MAX_CORRECTED, _CORRECTED_SHARE * before)]
    name, far = own[0].plate.name, f"its centre of pressure is {100 * before:.0f} cm from the nearest foot"
    if good:
        return f"{name} is {' or '.join(good)}: {far}.", "Likely, if nobody else is there: steps then lie under feet."
    if before < _FOOT_OFFSET:
        return "", ""
    return f"{name} does not lie under the feet: {far}.", "Certain; neither a shift nor a turn explains it."
