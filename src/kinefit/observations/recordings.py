"""Recordings: the data of one sensor over a whole take, checked, in metres, radians, seconds and pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import read_sides
from kinefit.bodies.motion import MarkerEvent
from kinefit.errors import ObservationError
from kinefit.geometry.force_plates import ForcePlate
from kinefit.observations.arrays import check_seen, freeze, frozen, sealed

_MAX_SCORE = 20.0  # heatmaps of OpenPose and HRNet reach 1.4, the SimCC heads of RTMW about 10, percentages 50 and more
_MIN_SCORE_EXCESS = 1.5  # no detector scores nearly all of its points higher: heatmaps 1.0 to 1.3 at their best
_OVERSHOOT = 0.1  # by which scores of heatmaps may fall below 0
_MAX_OVERSHOOT_SHARE = 0.01  # of scores that lie lower
_MAX_NEGATIVE_SHARE = 0.1  # of scores below 0: a depth relative to the hips has about half of them there
_MAX_SHARE_OF_IMAGE = 2.0  # a coordinate as a share of the image's size, of a point outside of the image too
_MIN_POINTS = 10  # that distinguish shares of the image from pixels in one corner
_MIN_SPREAD = 0.01  # of these, as a share of the image's size: a person; less is one place
_INSTEAD = (
    "Write the detector's confidence or visibility, 0 to 1, in its place. Without one, write 1 where a point is "
    "detected and 0 elsewhere."
)


def confidence_of(scores: NDArray, what: str, file: str | PathLike[str] | None = None) -> NDArray:
    """Confidence 0..1 of a detector's scores (any shape), 0 for undetected points.

    Scores of heatmaps exceed 1 and fall below 0 by little; they are clipped. COCO's flags 0 (not labelled), 1
    (occluded) and 2 (visible) become 0, 0.5 and 1, and -1 for an undetected point 0.

    Parameters
    ----------
    what, file : whose scores, and of which file, for the message.

    Raises
    ------
    ObservationError
        The values cannot be scores: depths, logits or percentages.
    """
    low, high = (float(of.reduce(scores, axis=None, initial=0.0)) for of in (np.fmin, np.fmax))
    if low >= 0.0 and high <= 1.0:
        return scores
    values = scores[np.isfinite(scores) & (scores != 0.0) & (scores != -1.0)]
    if not len(values):
        return np.maximum(scores, 0.0)
    if high == 2.0 and np.isin(values, (1.0, 2.0)).all():
        return np.clip(scores / 2.0, 0.0, 1.0)
    negative = float(np.mean(values < 0.0))
    is_high = np.percentile(values, 5) > _MIN_SCORE_EXCESS or np.percentile(values, 99) > _MAX_SCORE
    if negative > _MAX_NEGATIVE_SHARE or np.mean(values < -_OVERSHOOT) > _MAX_OVERSHOOT_SHARE:
        extent, cause = f", {100 * negative:.0f} % of them below 0", "This is a depth (z of MediaPipe), or logits."
    elif is_high and 50.0 < high <= 100.0:
        extent, cause = "", "If these are percentages, divide them by 100. Else this may be a depth."
    elif is_high:
        extent, cause = "", "This may be a depth, or logits."
    else:
        return np.clip(scores, 0.0, 1.0)
    extent = f"from {values.min():.3g} to {high:.3g}{extent}"
    problem = f"{what}: the value after x and y is no confidence or visibility: {extent}"
    raise ObservationError(problem, file=file, remedy=f"{cause} {_INSTEAD}")


def check_pixels(points: NDArray, confidence: NDArray, what: str, file: str | PathLike[str] | None = None) -> None:
    """Check that the coordinates of points (..., 2) with a confidence (...) 0..1 are pixels.

    Raises
    ------
    ObservationError
        They are shares of the image's size.
    """
    if any(abs(of.reduce(points, axis=None, initial=0.0)) > _MAX_SHARE_OF_IMAGE for of in (np.fmin, np.fmax)):
        return
    uv = points[(confidence > 0.0) & np.isfinite(points).all(axis=-1)]
    if len(uv) >= _MIN_POINTS and np.ptp(np.percentile(uv, (10, 90), axis=0), axis=0).max() > _MIN_SPREAD:
        problem = f"{what}: coordinates run from 0 to 1 (shares of the image's size), not over pixels"
        remedy = "Multiply x by the image's width and y by its height."
        raise ObservationError(problem, file=file, remedy=remedy)


KEYPOINT_SIGMA = 8.0
"""[px] default standard deviation of a keypoint of confidence 1: typical of detectors in images of 1,000 to 2,000 px in
which a person fills half of the height."""


def mirror_name(name: str) -> str:
    """Name of the point on the other side, in the detectors' spellings; the same name for one in the middle."""
    if name[:1] in "LR" and name[1:2].isupper():
        return ("R" if name[0] == "L" else "L") + name[1:]
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


@dataclass(frozen=True, eq=False)
class Keypoints:
    """2D keypoints of all people that a detector found in one camera.

    Parameters
    ----------
    camera : str
        Name of the camera in the rig.
    keypoint_set : str
        Name of the set ("BODY_25B", "COCO_17", "HALPE_26", "MEDIAPIPE_33"), which defines the names.
    names : (K,) names of the keypoints
    rate : float [Hz]
    points : (F, P, K, 2) [px]
        In the image frame of the camera's calibration (not of a scaled or letterboxed video). NaN for undetected
        keypoints. P is the largest number of people in any frame; their order has no meaning.
    confidence : (F, P, K)
        The detector's own confidence in 0..1; 0 for undetected keypoints. Other scores: see `confidence_of`.
    time_offset : float [s]
        Added to frame / rate to get the time of the take.
    source : str
        File or folder, for messages.
    lifted : (F, P, K, 3) [m], optional
        3D landmarks of a network, see `LiftedFrame`; NaN for undetected ones.
    sides_known : (F,) bool, optional
        Frames whose left and right are stated: no correction of swapped sides exchanges them.
    sigma : float [px], optional
        Standard deviation of a keypoint of confidence 1, where the detector was calibrated.
    looked : (F,) bool, optional
        Frames whose image the detector looked at; default: all. Between two looks the motion goes on.

    Raises
    ------
    ObservationError
        Arrays of other shapes; a confidence that is none (a depth, logits, percentages); coordinates that are shares
        of the image's size.
    """

    camera: str
    keypoint_set: str
    names: tuple[str, ...]
    rate: float
    points: NDArray
    confidence: NDArray
    time_offset: float = 0.0
    source: str = ""
    lifted: NDArray | None = None
    sides_known: NDArray | None = None
    sigma: float | None = None
    looked: NDArray | None = None

    def __post_init__(self) -> None:
        check_seen(self.camera, self.rate, self.names)
        what = f"keypoints of camera {self.camera}"
        points = frozen(self.points, float, what, ("frames", "people", len(self.names), 2), self.source)
        shape, lifted = points.shape[:3], self.lifted
        confidence = frozen(self.confidence, float, f"the confidence of {what}", shape, self.source)
        if points is not self.points or confidence is not self.confidence:  # no arrays of a record, which are checked
            confidence = sealed(confidence_of(confidence, what, self.source or None))
            check_pixels(points, confidence, what, self.source or None)
        if lifted is not None:
            lifted = frozen(lifted, float, f"lifted {what}", (*shape, 3), self.source)
        sides_known, looked = self.sides_known, self.looked
        if sides_known is not None:
            sides_known = frozen(sides_known, bool, f"the known sides of {what}", shape[:1], self.source)
        if looked is not None:
            looked = frozen(looked, bool, f"the looks of {what}", shape[:1], self.source)
        freeze(self, points=points, confidence=confidence, lifted=lifted, sides_known=sides_known, looked=looked)

    def __len__(self) -> int:
        return len(self.points)

    def rows(self, frames: slice, time_offset: float) -> Keypoints:
        """The keypoints of some frames; `time_offset` [s] is the time of the first."""
        sides_known, looked = (None if v is None else v[frames] for v in (self.sides_known, self.looked))
        return self._changed(
            lambda values: values[frames], time_offset=time_offset, sides_known=sides_known, looked=looked
        )

    def without(self, frames: NDArray) -> Keypoints:
        """The keypoints without the detections of some frames; `frames` (F,) bool."""
        points, confidence = np.array(self.points), np.array(self.confidence)
        points[frames], confidence[frames] = np.nan, 0.0
        lifted = None if self.lifted is None else np.where(frames[:, None, None, None], np.nan, self.lifted)
        return replace(self, points=points, confidence=confidence, lifted=lifted)

    def exchanged(self, frames: NDArray) -> Keypoints:
        """The keypoints with left and right of everybody exchanged in some frames, (F,) bool, and known there."""
        order = [self.names.index(m) if (m := mirror_name(n)) in self.names else k for k, n in enumerate(self.names)]

        def other(values: NDArray) -> NDArray:
            out = values.copy()
            out[frames] = values[frames][:, :, order]
            return out

        return self._changed(other, sides_known=frames)

    def first_points(self, keypoint_set: str, names: tuple[str, ...]) -> Keypoints:
        """The first points alone, as another keypoint set with these names."""
        return self._changed(lambda values: values[:, :, : len(names)], keypoint_set=keypoint_set, names=names)

    def _changed(self, change: Callable[[NDArray], NDArray], **fields: Any) -> Keypoints:
        """The record with each of its arrays of points (F, P, K, ...) changed, and other fields."""
        arrays = {name: getattr(self, name) for name in ("points", "confidence", "lifted")}
        changed: dict[str, Any] = {name: change(a) for name, a in arrays.items() if a is not None}
        return replace(self, **changed, **fields)

    def of_one(self, chosen: NDArray) -> Keypoints:
        """The keypoints of one person; chosen (F,) int is the person's number in each frame, -1 for none."""
        if self.points.shape[1] == 0:
            shape = len(self), 1, len(self.names)
            return replace(self, points=np.full((*shape, 2), np.nan), confidence=np.zeros(shape), lifted=None)
        frames, person = np.arange(len(self)), np.maximum(chosen, 0)

        def own(values: NDArray) -> NDArray:
            out = values[frames, person][:, None]
            out[chosen < 0] = 0.0 if values is self.confidence else np.nan
            return out

        return self._changed(own)

    @property
    def times(self) -> NDArray:
        """(F,) [s] time of every frame in the take."""
        return np.arange(len(self)) / self.rate + self.time_offset


@dataclass(frozen=True, eq=False)
class Markers:
    """3D positions of markers over time, labelled or unlabelled (names such as "*1").

    Parameters
    ----------
    names : (M,)
    rate : float [Hz]
    positions : (F, M, 3) [m]
        In the file's world frame; NaN for missing markers.
    residual : (F, M) [m] or None
        The system's own reconstruction residual.
    up : "x", "y", "z" or None
        Vertical axis of the world; None if the file does not state it.
    first_frame : int
        The file's number of its first frame.
    source : str
    unit : str, of the source file ("mm", "m" ...); positions are always in metres
    events : marked in the recording
    first_time : float [s]
        Time of the first frame on the recording's own clock, which forces and events of the trial share. Default: that
        of `first_frame`, where frame 1 is at 0 s, as in C3D.
    notes : tuple of str
        What the reader decided where the file contradicts itself, and what it lacks.
    plates : force plates of the recording, in the world and by the clock of the markers

    Raises
    ------
    ObservationError
        Positions of another shape.
    """

    names: tuple[str, ...]
    rate: float
    positions: NDArray
    residual: NDArray | None = None
    up: str | None = None
    first_frame: int = 0
    source: str = ""
    unit: str = "m"
    events: tuple[MarkerEvent, ...] = ()
    first_time: float = np.nan
    notes: tuple[str, ...] = ()
    plates: tuple[ForcePlate, ...] = ()

    def __post_init__(self) -> None:
        check_seen(self.source, self.rate, self.names)
        if np.isnan(self.first_time):
            object.__setattr__(self, "first_time", (self.first_frame - 1) / self.rate if self.first_frame > 1 else 0.0)
        freeze(self, positions=frozen(self.positions, float, "markers", ("frames", len(self.names), 3), self.source))
        if self.residual is not None:
            object.__setattr__(self, "residual", frozen(self.residual))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def times(self) -> NDArray:
        """(F,) [s] on the recording's own clock: the first is `first_time`."""
        return np.arange(len(self)) / self.rate + self.first_time

    @property
    def seen_frames(self) -> tuple[int, int]:
        """First frame that shows a marker, and one after the last; all frames where none does."""
        seen = np.flatnonzero(np.isfinite(self.positions[..., 0]).any(axis=1))
        return (int(seen[0]), int(seen[-1]) + 1) if len(seen) else (0, len(self))

    def sided(self, sides: str) -> Markers:
        """With left and right as `sides` states, see `read_sides`; a mirrored world loses its plates, with a note."""
        names, positions = read_sides(self.names, self.positions, sides)
        if not (self.plates and sides.startswith("mirrored")):
            return replace(self, names=names, positions=positions)
        text = "force plates are left out: nothing says whether they are mirrored, too"
        return replace(self, names=names, positions=positions, plates=(), notes=(*self.notes, text))

    def trimmed(self) -> Markers:
        """The recording without empty frames before its first marker and after its last, which `notes` then say."""
        first, stop = self.seen_frames
        if (first, stop) == (0, len(self)):
            return self
        text = f"no markers in the first {first} and last {len(self) - stop} of {len(self)} frames: left out"
        return replace(
            self, positions=self.positions[first:stop], first_time=float(self.times[first]),
            residual=None if self.residual is None else self.residual[first:stop],
            first_frame=self.first_frame + first, notes=(*self.notes, text),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """A recorded motion of any skeleton: joint frames over time (BVH, ASF/AMC).

    Parameters
    ----------
    names : (J,) joint names; end sites are named after their parent with the suffix "_end".
    parents : (J,) int, -1 for the root; parents come before children.
    offsets : (J, 3) [m] rest position of each joint in its parent's rest frame (world-aligned).
    rate : float [Hz]
    Ts_world_joint : (F, J, 4, 4)
        Pose of every joint frame in the file's world, translation in metres.
    up : "x", "y" or "z".
    source : str
    """

    names: tuple[str, ...]
    parents: NDArray
    offsets: NDArray
    rate: float
    Ts_world_joint: NDArray
    up: str = "y"
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parents", frozen(self.parents, int))
        object.__setattr__(self, "offsets", frozen(self.offsets))
        object.__setattr__(self, "Ts_world_joint", frozen(self.Ts_world_joint))

    def __len__(self) -> int:
        return len(self.Ts_world_joint)

    @property
    def positions(self) -> NDArray:
        """(F, J, 3) [m] joint positions in the world."""
        return self.Ts_world_joint[..., :3, 3]

    @property
    def rest(self) -> NDArray:
        """(J, 3) [m] joint positions in the rest pose, root offsets included, in the axes of the file's world."""
        rest = np.array(self.offsets)
        for joint, parent in enumerate(self.parents):
            rest[joint] += rest[parent] if parent >= 0 else 0.0
        return rest


FORMS = '"first", "moving", "largest", "nearest X Y Z" [m], or a number from 1'
"""Allowed forms, for messages."""

_MAX_DIGITS = 6  # of a person's number; Python refuses to read some thousand of them


@dataclass(frozen=True, eq=False)
class PersonChoice:
    """Criterion that selects the target person among several.

    Parameters
    ----------
    way : "first" (most detections), "moving" (largest motion of the points), "largest" (in the images), "nearest" (to
        `place`) or "number"
    number : int, from 1, in the list of `kinefit track`
    place : (3,) [m] in the world, for "nearest"
    """

    way: str = "first"
    number: int = 1
    place: NDArray | None = None

    @classmethod
    def of(cls, person: int | str | None) -> PersonChoice:
        """Parse a user's choice; None is "first".

        Raises
        ------
        ObservationError
            The choice is none of `FORMS`.
        """
        if person is None:
            return cls()
        if isinstance(person, bool) or not isinstance(person, int | str):
            raise _wrong(person)
        word, *more = str(person).split() or [""]
        if word.isascii() and word.isdigit() and not more and len(word) <= _MAX_DIGITS and int(word) > 0:
            return cls("number", int(word))
        if word in ("first", "moving", "largest") and not more:
            return cls(word)
        if word == "nearest" and len(more) == 3:
            try:
                place = np.array([float(value) for value in more])
            except ValueError:
                raise _wrong(person) from None
            if np.isfinite(place).all():
                return cls(word, place=place)
        raise _wrong(person)


def _wrong(person: object) -> ObservationError:
    return ObservationError(f"person = {str(person)[:60]!r}", remedy=f"Give {FORMS}.")
