"""The gait record of one person: strides and steps of several walks, their means, symmetry and variability."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.lasting_errors import differ
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.errors import ObservationError
from kinefit.exporters.report.cycles import Cycles, find_gait, take_turns
from kinefit.exporters.report.feet import HEEL, MIN_STRIDE_S, Feet, foot_events, foot_findings, upright
from kinefit.exporters.report.strides import QUANTITIES, Quantity, step_quantities, stride_quantities
from kinefit.findings import listed

SIDES, WALKS = ("left", "right"), ("straight", "turning")
_MAX_STRAIGHT_DEG = 20.0  # change of heading in a stride
_MIN_UPRIGHT, _MIN_STANDING = 0.2, 0.38  # hips above the lower heel, as shares of the stature: 0.5 standing
_MAX_LENGTH_RATIO = 1.08  # of thigh and shank of one person in two fits
_MAX_STEP_S = 1.5

Values = Mapping[str, tuple[float, float]]
"""{quantity: (value, standard deviation)}"""


@dataclass(frozen=True, eq=False)
class Walk:
    """One motion of a person who walks, without its ends in which no person was observed.

    Parameters
    ----------
    name : of the trial
    motion : Motion
    cycles : its strides; without any there are single steps
    feet : events of both feet
    notes : sentences for the user
    """

    name: str
    motion: Motion
    cycles: Cycles
    feet: Feet
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stride, from contact to contact of a foot, or a single step, from contact of the other foot to this one's.

    Parameters
    ----------
    trial : name of the walk
    kind : "stride" or "step"
    side : "left" or "right"
    start, stop : [s]
    walk : "straight" or "turning", by the change of the pelvis's heading
    values : {quantity: (value, standard deviation)}
    """

    trial: str
    kind: str
    side: str
    start: float
    stop: float
    walk: str
    values: Values


@dataclass(frozen=True, eq=False)
class GaitRecord:
    """The strides and steps of one person.

    Parameters
    ----------
    walks : in the order given
    stretches : of all walks
    notes : sentences for the user
    """

    walks: tuple[Walk, ...]
    stretches: tuple[Stretch, ...]
    notes: tuple[str, ...]

    def quantities(self, side: str, walk: str = "straight") -> dict[str, Quantity]:
        """{quantity: of each stride or step} of a side, or of "both"."""
        used = [one for one in self.stretches if side in (one.side, "both") and one.walk == walk]
        out = {}
        for name in QUANTITIES:
            pairs = np.array([one.values[name] for one in used if name in one.values]).reshape(-1, 2)
            if len(pairs):
                out[name] = Quantity(pairs[:, 0], pairs[:, 1])
        return out

    def compared(self, walk: str) -> Iterator[tuple[str, Quantity, Quantity, tuple[float, float]]]:
        """Each quantity: its name, of the left and of the right side, and their `symmetry`; NaN where there is none."""
        left, right = (self.quantities(side, walk) for side in SIDES)
        none = Quantity(np.zeros(0), np.zeros(0))
        for name in QUANTITIES:
            if name in left or name in right:
                a, b = left.get(name, none), right.get(name, none)
                share = (np.nan, np.nan) if name.endswith("[deg]") else symmetry(a, b)  # an angle may be about zero
                yield name, a, b, share

    @property
    def walk(self) -> str:
        """Which walk the record is of: "straight", or "turning" where there is no straight stride or step."""
        return WALKS[0] if any(one.walk == WALKS[0] for one in self.stretches) else WALKS[1]

    def count(self, kind: str, side: str, walk: str) -> int:
        """Number of strides or steps of a side."""
        return sum((one.kind, one.side, one.walk) == (kind, side, walk) for one in self.stretches)


def gait_record(motions: Mapping[str, Motion]) -> GaitRecord:
    """The record of one person's walks {name of the trial: Motion}.

    Motions without a stride or step are left out, and named with their reason in `notes`.

    Raises
    ------
    ObservationError
        None of the motions has a stride or step, or they are of different people.
    """
    doubts = _check_one_person(motions)
    walks, faults = [], dict[str, str]()
    for name, motion in motions.items():
        found = _walk(name, motion)
        if isinstance(found, str):
            faults[name] = found
        else:
            walks.append(found)
    if not walks:
        remedy = "Give a motion with two contacts of a foot, or one of each, over ground or on a treadmill."
        problem = f"no gait: {'; '.join(dict.fromkeys(faults.values()))}"
        raise ObservationError(problem, file=listed(motions), remedy=remedy)
    left_out = [f"{name} is left out: {fault}." for name, fault in faults.items()]
    notes = [f"{walk.name}: {note}" for walk in walks for note in walk.notes]
    stretches = tuple(one for walk in walks for one in _stretches(walk))
    return GaitRecord(tuple(walks), stretches, (*doubts, *left_out, *notes))


def symmetry(left: Quantity, right: Quantity) -> tuple[float, float]:
    """[%] difference of the sides, left minus right, as a share of their mean, with its standard deviation.

    The errors of both sides count as independent (Robinson et al. 1987, J. Manip. Physiol. Ther. 10:172-176).
    """
    a, b = left.mean, right.mean
    slopes = 400.0 * np.array([b, -a]) / (a + b) ** 2
    return 200.0 * (a - b) / (a + b), float(np.hypot(*(slopes * (left.std, right.std))))


def headings(motion: Motion) -> NDArray:
    """(F,) [rad] about the vertical, in which the pelvis faces: 0 along x of a world turned to y up, to the left."""
    across = np.diff(upright(motion, ("l_hip", "r_hip")), axis=1)[:, 0]
    return np.unwrap(np.arctan2(across[:, 0], across[:, 2]))


def _walk(name: str, motion: Motion) -> Walk | str:
    """What is walked in a motion; a sentence where nothing is."""
    seen = np.flatnonzero(motion.quality > 0.0)
    notes = []
    if len(seen) and seen[-1] - seen[0] + 1 < len(motion):
        notes.append(f"frames before {seen[0]} and after {seen[-1]} are left out: no person was observed.")
        motion = motion.part(slice(int(seen[0]), int(seen[-1]) + 1))
    fault = "no person was observed" if not len(seen) else _posture_fault(motion)
    feet = None if fault else foot_events(motion)
    if feet is None:
        return fault or "the body has no balls of the feet"
    cycles = find_gait(motion)
    if cycles is None:
        if not take_turns(feet) or not _single_steps(feet, {}):
            return _no_step(feet)
        cycles = Cycles("gait", (), np.nan, feet)
        notes.append("no stride repeats; single steps alone.")
    if not all(feet.observed):
        notes.append(f"only the {SIDES[feet.observed.index(True)]} leg was measured; steps and symmetry need both.")
    if feet.backwards:
        notes.append("the person walks backwards.")
    notes += [found.text for found in foot_findings(motion)]
    return Walk(name, motion, cycles, feet, tuple(notes))


def _posture_fault(motion: Motion) -> str:
    """Why a motion is no walk, by body and posture; "" where nothing speaks against it."""
    names = tuple(f"{s}_{n}" for s in "lr" for n in ("hip", HEEL))
    lacking = [n for n in names if n not in motion.body.landmarks.names]
    if lacking or len(motion) < 3:
        return f"the body has no landmarks {listed(lacking)}" if lacking else "it has fewer than three frames"
    heights = upright(motion, names)[..., 1].reshape(-1, 2, 2)
    height = float(np.median(heights[:, :, 0].mean(axis=1) - heights[:, :, 1].min(axis=1)))
    share = height / (motion.body.stature or 1.7)
    if share < _MIN_UPRIGHT:
        above = f"the hips are {height:.2f} m above the heels along {motion.up}"
        return f"{above}: the person lies, or {motion.up} is not up"
    return f"the person sits: the hips are {height:.2f} m above the heels" if share < _MIN_STANDING else ""


def _no_step(feet: Feet) -> str:
    counts = {side: len(foot.contacts) for side, foot in zip(SIDES, (feet.left, feet.right))}
    if not any(counts.values()):
        return "no foot steps past the other by an eighth of the stature"
    found = listed([f"{count} {side}" for side, count in counts.items()])
    return f"no two contacts of a foot that takes turns with the other (contacts: {found})"


def _single_steps(feet: Feet, strides: Mapping[str, NDArray]) -> list[tuple[str, float, float]]:
    """(side, contact of the other foot, contact of this one) [s] of steps that are in no stride (N, 2) of the side."""
    events = sorted([(float(t), side) for side, foot in zip(SIDES, (feet.left, feet.right)) for t in foot.contacts])
    out = []
    for (start, other), (stop, side) in pairwise(events):
        within = any(a < stop <= b for a, b in strides.get(side, ()))
        if other != side and 0.5 * MIN_STRIDE_S < stop - start < _MAX_STEP_S and not within:
            out.append((side, start, stop))
    return out


def _stretches(walk: Walk) -> list[Stretch]:
    """Strides and single steps of a walk."""
    motion, out = walk.motion, []
    heading = np.degrees(headings(motion))

    def kind_of_walk(start: float, stop: float) -> str:
        a, b = (float(np.interp(t, motion.times, heading)) for t in (start, stop))
        return WALKS[abs(b - a) > _MAX_STRAIGHT_DEG]

    for side in walk.cycles.sides:
        found = stride_quantities(motion, walk.feet, side.name, side.times)
        for k, (start, stop) in enumerate(side.times.tolist()):
            values = {n: (float(q.values[k]), float(q.stds[k])) for n, q in found.items() if np.isfinite(q.values[k])}
            out.append(Stretch(walk.name, "stride", side.name, start, stop, kind_of_walk(start, stop), values))
    for name, start, stop in _single_steps(walk.feet, {side.name: side.times for side in walk.cycles.sides}):
        values = step_quantities(motion, walk.feet, name, start, stop)
        turn = kind_of_walk(max(2.0 * start - stop, motion.times[0]), stop)  # of a step the pelvis turns both ways
        out.append(Stretch(walk.name, "step", name, start, stop, turn, values))
    return sorted(out, key=lambda one: one.start)


def straight_cycles(record: GaitRecord) -> list[tuple[Motion, Cycles]]:
    """Each stride of the record's walk as a motion that faces along x, with itself as the only cycle."""
    used = {(one.trial, one.side, one.start) for one in record.stretches if one.walk == record.walk}
    out = []
    for walk in record.walks:
        heading, up = headings(walk.motion), rotation_between_up(walk.motion.up, "y")
        for side in walk.cycles.sides:
            for k, (first, last) in enumerate(side.spans.tolist()):
                if (walk.name, side.name, float(side.times[k, 0])) not in used:
                    continue
                mean = float(heading[first : last + 1].mean())
                c, s = np.cos(mean), np.sin(mean)
                T = np.eye(4)
                T[:3, :3] = up.T @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ up
                part = walk.motion.part(slice(first, last + 1)).moved(T)
                spans, toe_off, times = np.array([[0, last - first]]), side.toe_off[k : k + 1], side.times[k : k + 1]
                one = replace(side, spans=spans, toe_off=toe_off, times=times)
                out.append((part, replace(walk.cycles, sides=(one,))))
    return out


def _check_one_person(motions: Mapping[str, Motion]) -> list[str]:
    """Sentences on motions that may be of other people; ObservationError where subjects or legs differ."""
    remedy = "Give the motions of one person at a time."
    people = {name: _subject(motion) for name, motion in motions.items()}
    named = {subject: name for name, subject in people.items() if subject}
    if len(named) > 1:
        each = listed([f"{subject} ({name})" for subject, name in named.items()])
        raise ObservationError(f"motions of {len(named)} people: {each}", file=next(iter(motions)), remedy=remedy)
    doubts, (first, *others) = [], motions
    for other in others:
        apart = _leg_ratio(motions[first].body, motions[other].body)
        if apart > _MAX_LENGTH_RATIO:
            problem = f"two people: the legs in {first} and {other} differ by {100 * (apart - 1):.0f} % in length"
            raise ObservationError(problem, file=other, remedy=remedy)
        one, two = motions[first].lasting, motions[other].lasting
        if one is not None and two is not None and differ(one, two):
            doubts.append(f"Lengths in {other} differ from {first} by more than their error bars: is it one person?")
    return doubts


def _leg_ratio(one: Body, other: Body) -> float:
    """How many times as long the legs of one of two bodies are, 1 or more."""
    lengths = [{n: v for n, v in b.segment_lengths().items() if n.startswith(("thigh", "shank"))} for b in (one, other)]
    both = lengths[0].keys() & lengths[1].keys()
    a, b = (sum(of[name] for name in both) for of in lengths)
    return max(a / b, b / a) if both else 1.0


def _subject(motion: Motion) -> str:
    session = motion.provenance.get("session")
    return str(session.get("subject", "")) if isinstance(session, Mapping) else ""
