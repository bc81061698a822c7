"""When a foot meets the ground and when it leaves it.

A foot swings where its heel goes from farthest behind the pelvis to farthest ahead of it (Zeni, Richards and Higginson
2008, "Two simple methods for determining gait events during treadmill and overground walking using kinematic data",
Gait & Posture 27:710-714). It stands where heel or toes are slow over the ground (as Ghoussayni et al. 2004, Gait &
Posture 20:266-272, with a share of the swing's speed in place of 50 mm/s): contact is where the first of heel and ball
falls below a share of its highest speed in the swing, toe-off where the tip of the toes, which leaves last and upwards,
rises above another. A treadmill's belt is ground, too: its velocity is that of what stands on it. Ahead is where the
pelvis goes: of who walks backwards, behind.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import MarkerEvent, Motion, rotation_between_up
from kinefit.exporters.gait.plates import CONTACT_STD_S, Footfall, by_plates, feet_on_plates
from kinefit.findings import Finding

LEAST_STEP = 0.12  # share of the stature that a foot travels to and fro at least: shuffling 20 cm strides of an adult
MIN_STRIDE_S = 0.4  # [s]: sprinters take 0.45 s
BELT_STD = 0.013  # [m/s] of a belt's velocity: the root mean square in ten walks of four people, as if on a belt
HEEL, BALL, TOE = "heel", ("metatarsal_phalanx_1", "metatarsal_phalanx_5"), "digit_1"  # of a foot, after "l_", "r_"
_CONTACT_SHARE, _OFF_SHARE = 0.1, 0.18  # of the swing's highest speed: no error against plates in the mean of five
# people (HC002D, HC036A and HC050A, the adult and the sprinter of forces_nimblephysics); each person counts once
_CONTACT_STD_S, _OFF_STD_S = 0.013, 0.0105  # of the next person: 7.8 and 5.5 ms between these people, as Student's t
# of five predicts another, 5.6 and 6.5 ms within one
_MARKED_STD_S = 0.009  # of laboratories' own events: they differ by 12.5 ms from ours, which are right to 8.5 ms, there
_MARKED_SIGMAS = 3.0  # of both together, beyond which they contradict each other
_AROUND_S = 0.15  # [s] before the first and after the last event of a foot: half a stride of a sprinter, and less
_LABELS = {"foot strike": "contacts", "heel strike": "contacts", "foot off": "offs", "toe off": "offs"}
_ROUGH_STD_S = 0.05  # of the extreme place alone, which is 49 ms early
_WAY_HZ, _SPEED_HZ = 6.0, 12.0  # what is faster is noise: walking has 99 % of its power below 6 Hz (Winter)
_BEFORE_S, _AFTER_S = 0.1, 0.25  # [s] of the extreme place, within which the event is sought
_LEAST_BELT, _FLAT_SHARE = 0.15, 0.3  # [m/s] of what stands: less is a floor; of the frames, in which it lies flat
_LEAST_BACK = 0.2  # [m/s] of a pelvis that moves backwards over the ground
_MIN_SEEN_SHARE = 0.5  # of the frames in which a leg is measured; with less it has no events


@dataclass(frozen=True, eq=False)
class FootEvents:
    """Contacts of one foot with the ground, and when it leaves it, each in increasing order.

    Parameters
    ----------
    side : "left" or "right"
    contacts, offs : (N,), (M,) [s] by the clock of the motion
    contact_std, off_std : (N,), (M,) [s]
    """

    side: str
    contacts: NDArray
    contact_std: NDArray
    offs: NDArray
    off_std: NDArray


@dataclass(frozen=True, eq=False)
class Feet:
    """Two feet over the ground.

    Parameters
    ----------
    left, right : their events
    belt : (2,) [m/s] velocity of the ground along x and z of a world whose y is up: zero, or a treadmill's
    observed : whether the left and the right leg were measured
    backwards : whether the person walks backwards
    """

    left: FootEvents
    right: FootEvents
    belt: NDArray
    observed: tuple[bool, bool] = (True, True)
    backwards: bool = False


@dataclass(frozen=True, eq=False)
class Footing:
    """What feet and force plates tell together.

    Parameters
    ----------
    feet : events of both feet, those of plates in place of what the feet show
    steps : of one foot alone on plates
    findings : what is wrong with plates, and which events of the recording contradict `feet`
    """

    feet: Feet
    steps: tuple[Footfall, ...]
    findings: tuple[Finding, ...]


_FOOTINGS: WeakKeyDictionary[Motion, Footing | None] = WeakKeyDictionary()  # of motions that are still in use


def footing(motion: Motion) -> Footing | None:
    """Feet and plates of a motion, found once; None where the body has no heels, toes or hips.

    Steps that are shorter than 12 % of the stature are left out, and what is next to the ends of the motion.
    """
    if motion not in _FOOTINGS:
        feet = feet_alone(motion)
        _FOOTINGS[motion] = None if feet is None else _with_files(motion, feet)
    return _FOOTINGS[motion]


def foot_events(motion: Motion) -> Feet | None:
    """Events of both feet, as `footing` finds them."""
    found = footing(motion)
    return found.feet if found else None


def _with_files(motion: Motion, feet: Feet) -> Footing:
    """Feet with what the plates and the files of the recording say of them."""
    belt = rotation_between_up(motion.up, "y").T @ [feet.belt[0], 0.0, feet.belt[1]]
    steps, findings = feet_on_plates(motion, [(f.contacts, f.offs) for f in (feet.left, feet.right)], belt)
    feet = replace(feet, left=_with_plates(feet.left, steps), right=_with_plates(feet.right, steps))
    return Footing(feet, tuple(steps), (*findings, *marked_findings(motion.events, feet)))


def feet_alone(motion: Motion) -> Feet | None:
    """Events of both feet as they show them alone, without plates; None as in `footing`."""
    names = [f"{s}_{n}" for s in "lr" for n in ("hip", HEEL, *BALL, TOE)]
    if any(name not in motion.body.landmarks.names for name in names) or len(motion) < 3:
        return None
    hips, heels, first, fifth, toes = np.moveaxis(upright(motion, names).reshape(len(motion), 2, 5, 3), 2, 0)
    feet = np.stack([heels, 0.5 * (first + fifth), toes], axis=2)  # (F, side, heel, ball and toe, 3)
    across = hips[:, 1] - hips[:, 0]
    forward = np.cross([0.0, 1.0, 0.0], across)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    ahead = np.einsum("fspi,fi->fsp", feet - hips.mean(axis=1)[:, None, None], forward)
    velocity = np.gradient(smoothed(feet, motion.rate, _SPEED_HZ), 1.0 / motion.rate, axis=0)
    pelvis, observed = hips.mean(axis=1), _observed(motion)
    measured = np.flatnonzero(observed)
    belt = _belt(feet[:, measured, :2], velocity[:, measured, :2, ::2], pelvis[:, ::2], motion.rate)
    speed = np.linalg.norm(velocity - [belt[0], 0.0, belt[1]], axis=-1)
    way = np.gradient(smoothed(pelvis, motion.rate), 1.0 / motion.rate, axis=0)[:, ::2] - belt
    backwards = bool(np.median(np.sum(way * forward[:, ::2], axis=1)) < -_LEAST_BACK)
    least = LEAST_STEP * (motion.body.stature or 1.7)
    ahead = (-ahead if backwards else ahead) * observed[:, None]  # of a leg that was not measured nothing is known
    left, right = (_events(motion, name, ahead[:, s], speed[:, s], least) for s, name in enumerate(("left", "right")))
    return Feet(left, right, belt, (bool(observed[0]), bool(observed[1])), backwards)


def upright(motion: Motion, names: Sequence[str]) -> NDArray:
    """(F, K, 3) [m] landmarks in a world turned to y up."""
    return motion.positions(motion.body.landmarks.select(tuple(names))) @ rotation_between_up(motion.up, "y").T


def foot_findings(motion: Motion) -> tuple[Finding, ...]:
    """What `footing` finds wrong with force plates and with the events of the recording."""
    found = footing(motion)
    return found.findings if found else ()


def foot_event(event: MarkerEvent) -> tuple[str, str] | None:
    """Side and kind, "contacts" or "offs", of an event of a recording; None of any other."""
    side, kind = event.context.lower(), _LABELS.get(event.label.lower())
    return (side, kind) if kind and side in ("left", "right") else None


def marked_findings(events: Iterable[MarkerEvent], feet: Feet) -> list[Finding]:
    """Events of a recording's files that lie farther from those found than three standard deviations of both."""
    wrong: dict[str, list[str]] = {}
    for event in events:
        if (known := foot_event(event)) and (text := _contradiction(event.time, *known, feet)):
            wrong.setdefault(event.source or "the recording", []).append(text)
    text = "Events of {} contradict feet and plates: {}. Those found are used."
    sure, remedy = "Likely: beyond three standard deviations of both.", "Correct the events or the clock of that file."
    return [Finding("doubt", "events", text.format(f, "; ".join(of)), (), sure, remedy) for f, of in wrong.items()]


def _contradiction(time: float, side: str, kind: str, feet: Feet) -> str:
    """How an event of a foot at a time [s] contradicts those found; "" where it does not, or none can be known."""
    foot, other = (feet.left, feet.right) if side == "left" else (feet.right, feet.left)
    both = np.concatenate([foot.contacts, foot.offs])
    times, stds = (foot.contacts, foot.contact_std) if kind == "contacts" else (foot.offs, foot.off_std)
    if not len(times) or not both.min() - _AROUND_S < time < both.max() + _AROUND_S:
        return ""
    marked = f"{side} {'contact' if kind == 'contacts' else 'toe-off'} at {time:.3f} s"
    near = int(np.argmin(np.abs(times - time)))
    late, sure = float(times[near] - time), _MARKED_SIGMAS * float(np.hypot(stds[near], _MARKED_STD_S))
    if abs(late) <= sure:
        return ""
    if np.min(np.abs(getattr(other, kind) - time), initial=np.inf) < sure:
        return f"{marked} (there the {other.side} foot has it)"
    by = "by a plate " if stds[near] == CONTACT_STD_S else ""
    return f"{marked} (found {by}{abs(late):.3f} ± {2.0 * stds[near]:.3f} s {'later' if late > 0 else 'earlier'})"


def _with_plates(foot: FootEvents, steps: Sequence[Footfall]) -> FootEvents:
    """Events of a foot, with those of plates in place of its own."""
    contacts, contact_std = by_plates(steps, foot.side, "contact", foot.contacts, foot.contact_std)
    return FootEvents(foot.side, contacts, contact_std, *by_plates(steps, foot.side, "off", foot.offs, foot.off_std))


def _observed(motion: Motion) -> NDArray:
    """(2,) bool: whether the left and the right leg were measured, on the shank or the foot; both where neither was."""
    marks, out = motion.body.landmarks, np.zeros(2, bool)
    for s, side in enumerate("lr"):
        foot = int(marks.segments[marks.index(f"{side}_{HEEL}")])
        measured = motion.segment_quality[:, [foot, max(int(motion.body.tree.parents[foot]), 0)]] > 0.0
        out[s] = measured.any(axis=1).mean() > _MIN_SEEN_SHARE
    return out if out.any() else ~out


def _belt(feet: NDArray, velocity: NDArray, pelvis: NDArray, rate: float) -> NDArray:
    """(2,) [m/s] horizontal velocity of the ground: zero, or that of a belt on which a person stays about in place.

    Parameters
    ----------
    feet : (F, 1 or 2, 2, 3) [m] heels and balls, y up; velocity : (F, 1 or 2, 2, 2) [m/s] along x and z
    pelvis : (F, 2) [m] along x and z; rate : float [Hz]
    """
    lower = np.argmin(feet[..., 1].mean(axis=2), axis=1)  # of two feet the one that stands
    ends = velocity[np.arange(len(feet)), lower]
    apart = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)  # a foot that lies flat goes with the ground as a whole
    median = np.median(ends[apart <= np.quantile(apart, _FLAT_SHARE)].mean(axis=1), axis=0)
    speed = float(np.linalg.norm(median))
    moved = float(np.linalg.norm(pelvis[-1] - pelvis[0])) * rate / (len(pelvis) - 1)
    return np.asarray(median if speed > max(_LEAST_BELT, 2.0 * moved) else np.zeros(2))


def _events(motion: Motion, side: str, ahead: NDArray, speed: NDArray, least: float) -> FootEvents:
    """Of a foot whose heel, ball and toe are so far ahead (F, 3) [m], at a speed (F, 3) [m/s] over the ground."""
    apart, rate = round(MIN_STRIDE_S * motion.rate), motion.rate
    way = smoothed(ahead, rate, _WAY_HZ)
    strikes, leaves = (peaks(sign * way[:, 0], least, apart) for sign in (1.0, -1.0))
    found: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for is_contact, extremes in ((True, strikes), (False, leaves)):
        for k in extremes:
            exact = _standing(speed, int(k), rate, is_contact)
            std = (_CONTACT_STD_S if is_contact else _OFF_STD_S) if exact is not None else _ROUGH_STD_S
            frame = float(k) if exact is None else exact
            time = float(np.interp(frame, np.arange(len(motion)), motion.times))
            found[is_contact].append((time, float(np.hypot(std, 1.0 / (rate * np.sqrt(12.0))))))
    contacts, offs = (np.array(found[key]).reshape(-1, 2) for key in (True, False))
    return FootEvents(side, contacts[:, 0], contacts[:, 1], offs[:, 0], offs[:, 1])


def _standing(speed: NDArray, extreme: int, rate: float, is_contact: bool) -> float | None:
    """Frame, with its fraction, where a foot begins or ends to stand near the frame of its extreme place.

    `speed` (F, 3) [m/s] of heel, ball and toe over the ground.
    """
    swing = slice(extreme, extreme + round(MIN_STRIDE_S * rate))
    if is_contact:  # the swing is before; time runs backwards for toe-off alone
        swing = slice(max(extreme - round(MIN_STRIDE_S * rate), 0), extreme + 1)
    if not len(speed[swing]):
        return None
    share = _CONTACT_SHARE if is_contact else _OFF_SHARE
    found = []
    for v in (speed[:, :2] if is_contact else speed[:, 2:]).T:
        limit = share * v[swing].max()
        if is_contact:
            first, last = swing.start + int(np.argmax(v[swing])) + 1, extreme + round(_AFTER_S * rate)
            slow = np.flatnonzero(v[first : last + 1] < limit)
            at = first + int(slow[0]) if len(slow) else None
        else:
            first, last = max(extreme - round(_BEFORE_S * rate), 1), swing.start + int(np.argmax(v[swing]))
            slow = np.flatnonzero(v[first : last + 1] < limit)
            at = first + int(slow[-1]) + 1 if len(slow) else None
        if at is not None and 0 < at < len(v):
            found.append(at - 1 + (limit - v[at - 1]) / (v[at] - v[at - 1]))
    inside = [frame for frame in found if -_BEFORE_S * rate <= frame - extreme <= _AFTER_S * rate]
    return min(inside) if inside else None


def smoothed(values: NDArray, rate: float, cutoff: float = _WAY_HZ) -> NDArray:
    """Values (F, ...) without what is faster than about `cutoff` [Hz] (zero phase, a Gaussian)."""
    from scipy.ndimage import gaussian_filter1d

    sigma = rate / (2 * np.pi * cutoff) * np.sqrt(np.log(2.0))
    reach = min(int(np.ceil(4 * sigma)), len(values) - 1)
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0)[reach : reach + len(values)])


def peaks(values: NDArray, prominence: float, apart: int) -> NDArray:
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
