"""Everybody in view of a take's sensors, and each of them apart from the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.motion import ARRAYS, Motion
from kinefit.errors import KinefitError, TrackingError
from kinefit.fitting.initialization.from_depth import StartSearch, start_from_points
from kinefit.fitting.multiview.followed import PersonKeypoints, choose, follow
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.fitting.smoothing.foot_contacts import FloorPlane
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.fitting.tracking.video import track
from kinefit.images.depth import denoised, to_points, without_speckles
from kinefit.images.depth_scene import DepthBlob, find_floor, foreground, people
from kinefit.observations import DepthFrame
from kinefit.readers.take.file import Take
from kinefit.readers.take.kinds import kinds_of
from kinefit.readers.take.load import Observations
from kinefit.readers.take.videos import TakePictures
from kinefit.rigs.diagnostics.images import load_uncovered
from kinefit.sensors.settings import TrackSettings

_LIKE = 0.4  # score of a start in a thing that is a person: 0.45 and more of people of another size than the body's
_SURELY = 0.6  # the same of one that no furniture reaches: boxes come to 0.5, so below it a person has to move
_MIN_STATIC_OVERLAP = 0.8  # of the pixels of a static object: 0.95 and more of furniture, noisy edges included
_MAX_BLOBS = 4  # things in a depth image that are looked at
_MAX_DUPLICATE_DISTANCE_M = 0.3  # [m] two roots that are nearer are of one person
_WALK = 3.0  # [m/s]
_STRIDE = 0.5  # [m] by which the middle of what is seen of a person moves without a step


@dataclass(frozen=True, eq=False)
class InView:
    """What the sensors of a take saw, and everybody in it.

    Parameters
    ----------
    seen : Observations
    people : in order of decreasing visibility; empty if only one was ever detected
    depth : of each of them, some depth images by step that show this person alone; empty if keypoints tell people apart
    starts : of each of them step and state to begin with, likewise
    floors : the floor that the first tracked person stands on, once it is found: the others share that world
    """

    seen: Observations
    people: tuple[PersonTrack, ...]
    depth: tuple[Mapping[int, DepthFrame], ...] = ()
    starts: tuple[tuple[int, BodyState], ...] = ()
    floors: list[FloorPlane] = field(default_factory=list)
    _motions: dict[int, Motion] = field(default_factory=dict)

    def recording(
        self, recording: Recording, body: Body, person: int | str | None, settings: TrackSettings
    ) -> Recording:
        """The recording of one person, with the motions of all others, by which its sensors are parted.

        Raises
        ------
        ObservationError, TrackingError
            A person in no known form; a number that is more than there are people.
        """
        number = choose(self.people, person)
        if len(self.people) < 2:
            return recording
        shared = self.depth or recording.sees_more
        if not shared:
            return recording
        motions = [self._motion(k, recording, body, settings) for k in range(len(self.people))]
        own = motions[number]
        others = tuple(
            m if own is None or k < number else _elsewhere(m, own)
            for k, m in enumerate(motions) if k != number and m is not None
        )  # fmt: skip
        return replace(self._of(number, recording), others=tuple(m for m in others if len(m)))

    def _of(self, number: int, recording: Recording) -> Recording:
        if not self.depth:
            return recording
        who = PersonKeypoints((), self.people, number + 1)
        return replace(recording, depth=self.depth[number], start=self.starts[number], followed=who)

    def _motion(self, k: int, recording: Recording, body: Body, settings: TrackSettings) -> Motion | None:
        """Of one person, roughly: from keypoints alone, or from depth as if this person were alone; None if lost."""
        if k not in self._motions:
            try:
                if self.depth:
                    self._motions[k] = track(self._of(k, recording), body, settings=settings, smooth=False)
                else:
                    own = Recording.of_keypoints(
                        recording.rig, self.seen.keypoints, person=k + 1, people=self.people, up=recording.up
                    )
                    self._motions[k] = track(own, body, settings=settings)
            except KinefitError:
                return None
        return self._motions[k]


def _elsewhere(motion: Motion, own: Motion) -> Motion:
    """The frames of a motion in which it is not where one's own is: there both follow one person, the first listed."""
    k = np.abs(motion.times[:, None] - own.times).argmin(axis=1)
    apart = motion.Ts_world_root[:, :3, 3] - own.Ts_world_root[k, :3, 3]
    use = np.linalg.norm(apart, axis=1) > _MAX_DUPLICATE_DISTANCE_M
    arrays = {name: getattr(motion, name)[use] for name in ARRAYS}
    return replace(motion, **arrays, residuals={}, lasting=None)


def people_in_view(take: Take) -> InView | None:
    """Find everybody that a take's keypoints show, or the first depth images where it has none.

    None where markers, lines or other points take part, which are not parted by people, or where the take tells itself
    where a body is.
    """
    points = take.markers or take.skin or not all(kind.shows_everybody for kind in kinds_of(take))
    if points or not (take.keypoints or ((take.depth or take.stereo) and not (take.start or take.pose))):
        return None
    seen = load_uncovered(take)
    if take.keypoints:
        if seen.rig is None:
            return None
        with TakePictures(take, seen) as pictures:
            return InView(seen, follow(seen.rig, seen.keypoints, images=pictures).people)
    body = load_body(take.body)
    return people_in_depth(seen, recording_of(take, seen, body)[0], body)


def people_in_depth(seen: Observations, recording: Recording, body: Body) -> InView:
    """Everybody who stands apart from the others in one of the first depth images, the one best explained first.

    Things of a person's size count as people where the body explains them, surely or while they move.
    """
    found = {step: _blobs(frame, recording) for step, frame in recording.depth.items()}
    step = max(found, key=lambda s: (len(found[s]), -s), default=-1)
    if step < 0 or len(found[step]) < 2:
        return InView(seen, ())
    frame = recording.depth[step]
    camera = recording.rig[frame.sensor]
    scored: list[tuple[float, DepthBlob, BodyState]] = []
    for blob in found[step][:_MAX_BLOBS]:
        alone = np.where(blob.mask, frame.depth, 0.0)
        try:
            search = StartSearch(count=1, attempts=1)
            start = start_from_points(body, None, camera, alone, up=recording.up_axis, search=search)[0]
        except TrackingError:
            continue
        if start.score > (_LIKE if _moves(blob, step, found) else _SURELY):
            scored.append((start.score * float(blob.mask.sum()), blob, start.state))
    scored.sort(key=lambda one: -one[0])
    every = [blob for _, blob, _ in scored]
    if len(every) < 2:
        return InView(seen, ())
    images = tuple(_of_blob(k, every, step, found, recording) for k in range(len(every)))
    persons = tuple(_person(blob, confidence, len(recording)) for confidence, blob, _ in scored)
    return InView(seen, persons, images, tuple((step, state) for *_, state in scored))


def _blobs(frame: DepthFrame, recording: Recording) -> list[DepthBlob]:
    """Things of a person's size in a depth image, the largest first."""
    camera = recording.rig[frame.sensor]
    depth = denoised(without_speckles(frame.depth, camera, closed=True), camera)
    empty = recording.backgrounds.get(frame.sensor)
    floor = find_floor(to_points(depth, camera, step=max(camera.size[0] // 160, 1)), recording.up_axis)
    return list(people(depth, camera, mask=None if empty is None else foreground(depth, empty), floor=floor))


def _of_blob(
    k: int, every: Sequence[DepthBlob], step: int, found: Mapping[int, Sequence[DepthBlob]], recording: Recording
) -> dict[int, DepthFrame]:
    """Depth images by step without the other people: where each is a thing by itself, near to where it was."""
    out = {}
    for at, frame in recording.depth.items():
        reach = _STRIDE + _WALK * abs(at - step) / recording.rate
        near = [_nearest(blob, found[at], reach) for blob in every]
        if near[k] is None or any(near[k] is other for j, other in enumerate(near) if j != k):
            continue
        theirs = [b.mask for j, b in enumerate(near) if b is not None and j != k]
        hidden = np.logical_or.reduce(theirs) if theirs else np.zeros(frame.depth.shape, bool)
        out[at] = replace(frame, depth=np.where(hidden, 0.0, frame.depth).astype(np.float32))
    return out


def _moves(blob: DepthBlob, step: int, found: Mapping[int, Sequence[DepthBlob]]) -> bool:
    """Whether an object covers other pixels in another image, unlike furniture; False if there is one image."""
    others = [found[at] for at in found if at != step]
    overlaps = [max((_overlap(blob.mask, b.mask) for b in among), default=0.0) for among in others]
    return min(overlaps, default=1.0) < _MIN_STATIC_OVERLAP


def _overlap(one: NDArray, other: NDArray) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


def _nearest(blob: DepthBlob, among: Sequence[DepthBlob], reach: float) -> DepthBlob | None:
    if not among:
        return None
    away = [float(np.linalg.norm(other.centre - blob.centre)) for other in among]
    best = int(np.argmin(away))
    return among[best] if away[best] < reach else None


def _person(blob: DepthBlob, confidence: float, steps: int) -> PersonTrack:
    rows: NDArray = np.flatnonzero(blob.mask.any(axis=1))
    return PersonTrack((), np.ones(steps, int), confidence, 0.0, float(np.ptp(rows)), np.asarray(blob.centre))
