"""When a foot meets the ground and when it leaves it.

A foot swings where its heel goes from farthest behind the pelvis to farthest ahead of it (Zeni, Richards and Higginson
2008, "Two simple methods for determining gait events during treadmill and overground walking using kinematic data",
Gait & Posture 27:710-714). It stands where heel or ball are slow over the ground (as Ghoussayni et al. 2004, Gait &
Posture 20:266-272, with a share of the swing's speed in place of 50 mm/s): contact is where the first of them falls
below a share of its highest speed in the swing, toe-off where the ball rises above another. A treadmill's belt is
ground, too: its velocity is that of what stands on it. Ahead is where the pelvis goes: of who walks backwards, behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.exporters.gait.plates import Footfall, by_plates, footfalls_in_time, plate_findings
from kinefit.findings import Finding

LEAST_STEP = 0.12  # share of the stature that a foot travels to and fro at least: shuffling 20 cm strides of an adult
MIN_STRIDE_S = 0.4  # [s]: sprinters take 0.45 s
HEEL, BALL = "heel", ("metatarsal_phalanx_1", "metatarsal_phalanx_5")  # landmarks of a foot, after "l_" or "r_"
_CONTACT_SHARE, _OFF_SHARE = 0.09, 0.22  # of the swing's highest speed. Chosen on three children (HC002D, HC036A,
# HC050A of the shared gait recordings), so that neither plates nor the files' own events are missed by more than 8 ms
_CONTACT_STD_S, _OFF_STD_S = 0.01, 0.009  # of what is so found, there, against plates
_ROUGH_STD_S = 0.05  # of the extreme place alone, which is 49 ms early
_WAY_HZ, _SPEED_HZ = 6.0, 12.0  # what is faster is noise: walking has 99 % of its power below 6 Hz (Winter)
_BEFORE_S, _AFTER_S = 0.1, 0.25  # [s] of the extreme place, within which the event is sought
_LEAST_BELT = 0.15  # [m/s] of what stands: less is a floor
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


def foot_events(motion: Motion, *, plates: bool = True) -> Feet | None:
    """Events of the left and of the right foot; None where the body has no heels, balls of the feet or hips.

    What force plates measured counts in place of what the feet show; with `plates` false it is left aside. Steps that
    are shorter than 12 % of the stature are left out, and what is next to the ends of the motion.
    """
    names = [f"{s}_{n}" for s in "lr" for n in ("hip", HEEL, *BALL)]
    if any(name not in motion.body.landmarks.names for name in names) or len(motion) < 3:
        return None
    upright = motion.positions(motion.body.landmarks.select(tuple(names))) @ rotation_between_up(motion.up, "y").T
    hips, heels, first, fifth = np.moveaxis(upright.reshape(len(motion), 2, 4, 3), 2, 0)
    feet = np.stack([heels, 0.5 * (first + fifth)], axis=2)  # (F, side, heel and ball, 3)
    across = hips[:, 1] - hips[:, 0]
    forward = np.cross([0.0, 1.0, 0.0], across)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    ahead = np.einsum("fspi,fi->fsp", feet - hips.mean(axis=1)[:, None, None], forward)
    velocity = np.gradient(smoothed(feet, motion.rate, _SPEED_HZ), 1.0 / motion.rate, axis=0)[..., ::2]
    pelvis, observed = hips.mean(axis=1), _observed(motion)
    measured = np.flatnonzero(observed)
    belt = _belt(feet[:, measured], velocity[:, measured], pelvis[:, ::2], motion.rate)
    speed = np.linalg.norm(velocity - belt, axis=-1)
    way = np.gradient(smoothed(pelvis, motion.rate), 1.0 / motion.rate, axis=0)[:, ::2] - belt
    backwards = bool(np.median(np.sum(way * forward[:, ::2], axis=1)) < -_LEAST_BACK)
    least = LEAST_STEP * (motion.body.stature or 1.7)
    ahead = (-ahead if backwards else ahead) * observed[:, None]  # of a leg that was not measured nothing is known
    left, right = (_events(motion, name, ahead[:, s], speed[:, s], least) for s, name in enumerate(("left", "right")))
    events = [(foot.contacts, foot.offs) for foot in (left, right)]
    steps = footfalls_in_time(motion, events) if plates and motion.plates else []
    sides = (_with_plates(left, steps), _with_plates(right, steps))
    return Feet(*sides, belt, (bool(observed[0]), bool(observed[1])), backwards)


def plate_faults(motion: Motion) -> list[Finding]:
    """What is wrong with the force plates of a motion, by what its feet show alone."""
    feet = foot_events(motion, plates=False) if motion.plates else None
    return plate_findings(motion, [(f.contacts, f.offs) for f in (feet.left, feet.right)]) if feet else []


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
    frames = np.arange(len(feet))
    slower = np.argmin(np.linalg.norm(velocity[frames, lower], axis=-1), axis=1)
    median = np.median(velocity[frames, lower, slower], axis=0)
    speed = float(np.linalg.norm(median))
    moved = float(np.linalg.norm(pelvis[-1] - pelvis[0])) * rate / (len(pelvis) - 1)
    return np.asarray(median if speed > max(_LEAST_BELT, 2.0 * moved) else np.zeros(2))


def _events(motion: Motion, side: str, ahead: NDArray, speed: NDArray, least: float) -> FootEvents:
    """Of a foot whose heel and ball are so far ahead (F, 2) [m], at a speed (F, 2) [m/s] over the ground."""
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

    `speed` (F, 2) [m/s] of heel and ball over the ground.
    """
    swing = slice(extreme, extreme + round(MIN_STRIDE_S * rate))
    if is_contact:  # the swing is before; time runs backwards for toe-off alone
        swing = slice(max(extreme - round(MIN_STRIDE_S * rate), 0), extreme + 1)
    if not len(speed[swing]):
        return None
    share = _CONTACT_SHARE if is_contact else _OFF_SHARE
    found = []
    for v in (speed.T if is_contact else speed[:, 1:].T):
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
