"""A take with depth: everything that its sensors saw, step by step, and the person's own size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.marker_sets import bare, known_set, matched
from kinefit.errors import CalibrationError, KinefitError, TakeError
from kinefit.geometry.camera import Rig
from kinefit.images.depth_scene import background_model
from kinefit.images.stereo import StereoRectifier
from kinefit.motion import UP_AXES, Motion
from kinefit.multiview.association import choose_people
from kinefit.observations import (
    CloudVideo,
    DepthFrame,
    DepthVideo,
    Frame,
    KeypointFrame,
    Keypoints,
    MarkerFrame,
    Markers,
    SilhouetteVideo,
)
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.video import Video
from kinefit.sensors.channels import make_channels
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.keypoints import Progress, fit_subject
from kinefit.tracking.fusion import FusionTracker
from kinefit.tracking.fusion_run import Sized, run_steps, sized_by_depth
from kinefit.tracking.silhouette_take import shaped_by_silhouettes, silhouettes_of

_SIZES = 4  # depth images from which a person's size is found ...
_FIRST = 5.0  # [s] ... spread over so much of the beginning
_EMPTY = 30  # images of an empty scene that are looked at: more tell no more


def fuse_take(
    take: Take, seen: Observations, *, settings: TrackSettings | None = None, size: bool = True,
    progress: Progress | None = None,
) -> Motion:  # fmt: skip
    """Motion of the person of a take from depth, keypoints and markers at once.

    Parameters
    ----------
    take : Take
    seen : Observations of it
    size : bool
        Whether the body is fitted to the person first: by keypoints of two cameras where there are, else by depth.

    Raises
    ------
    KinefitError
        What the sensors' readers and the tracker raise.
    """
    if take.silhouettes and not (take.start or take.keypoints or take.markers or take.depth or take.stereo):
        raise TakeError(
            "silhouettes alone do not tell where the body is to begin with", file=take.path, place="[[silhouette]]",
            remedy='Add [[keypoints]] with frames = [0, 1], or start = "motion.npz" to [take].',
        )  # fmt: skip
    source = FrameSource(take, seen)
    up = np.array(UP_AXES[take.up])
    found = Sized(load_body(take.body)) if take.start is None else _started(take)
    if size and take.start is None:
        found = _sized(found.body, take, source, up, progress)
    times = np.arange(*seen.frames) / seen.rate

    def tracker_of(body: Body) -> FusionTracker:
        return FusionTracker(
            body, source.rig, rate=seen.rate, accuracy=source.accuracy(take), up=up, settings=settings,
            on_body=[video.sensor for video in source.depth if video.on_body],
        )  # fmt: skip

    if size and source.silhouettes:
        first, own = tracker_of(found.body), found.body
        shaped = shaped_by_silhouettes(first, lambda i: source.at(i, own), times, start=found.start, progress=progress)
        if shaped is not None:
            sizes = dict(zip(shaped.fit.names, map(float, shaped.fit.values)))
            found = Sized(shaped.body, shaped.start, {**found.told, "shape": sizes})
    body, tracker = found.body, tracker_of(found.body)
    for video in source.depth:
        if video.background is not None:
            empty = [video.background.frame(i).depth for i in range(min(len(video.background), _EMPTY))]
            tracker.know_background(video.sensor, background_model(empty, share=0.5))
    return run_steps(
        tracker, lambda i: source.at(i, body), times, up=take.up, start=found.start, name=take.name,
        provenance=found.told, progress=progress,
    )  # fmt: skip


def _started(take: Take) -> Sized:
    """Body and first state as a motion file tells them."""
    assert take.start is not None
    motion = read_motion(take.start)
    return Sized(motion.body, (0, BodyState(motion.Ts_world_root[0], motion.angles[0])))


@dataclass(frozen=True)
class _Stereo:
    """A stereo pair as a recording of depth."""

    rectifier: StereoRectifier
    left: Video
    right: Video

    def image(self, i: int) -> NDArray:
        return self.rectifier.frame(self.left.read(i), self.right.read(i), 0.0).depth


class FrameSource:
    """What all sensors of a take saw at each of its steps.

    Parameters
    ----------
    take : Take
    seen : Observations

    Attributes
    ----------
    rig : Rig with all cameras, rectified stereo pairs among them.
    depth : tuple of DepthVideo, stereo pairs among them.
    silhouettes : tuple of SilhouetteVideo
    """

    def __init__(self, take: Take, seen: Observations) -> None:
        self.seen, self._sets = seen, [entry.set for entry in take.markers]
        pairs = [self._pair(take, seen, entry) for entry in take.stereo]
        self.depth: tuple[DepthVideo, ...] = (*seen.depth, *(video for video, _ in pairs))
        cameras = (*(seen.rig or ()), *(camera for _, camera in pairs))
        if not cameras:
            raise TakeError("no camera of the take is calibrated", file=take.path, remedy="Add [calibration].")
        self.rig = Rig(cameras)
        self.silhouettes: tuple[SilhouetteVideo, ...] = silhouettes_of(take, seen)
        self._offsets = [entry.time_offset for entry in take.markers]
        self.people: list[NDArray] = []
        if seen.keypoints:
            self.people = choose_people(self.rig, seen.keypoints)

    @staticmethod
    def _pair(take: Take, seen: Observations, entry: Any) -> tuple[DepthVideo, Any]:
        lacking = [name for name in (entry.left, entry.right) if name not in seen.videos]
        if lacking or seen.rig is None:
            problem = f"no video of camera {', '.join(lacking)}" if lacking else "its cameras are not calibrated"
            raise TakeError(problem, file=take.path, place=f"stereo {entry.name}", remedy="Add it to the [[camera]].")
        near, far = entry.range
        try:
            left, right = seen.rig[entry.left], seen.rig[entry.right]
            rectifier = StereoRectifier(left, right, near=near, far=far, name=entry.name)
        except KinefitError as error:
            raise CalibrationError(error.problem, file=take.path, place=error.place, remedy=error.remedy) from error
        both = _Stereo(rectifier, Video(seen.videos[entry.left]), Video(seen.videos[entry.right]))
        count = min(len(both.left), len(both.right))
        video = DepthVideo(
            sensor=entry.name, rate=seen.rate, times=np.arange(count) / seen.rate, size=rectifier.camera.size,
            image=both.image, near=near, far=far, camera=rectifier.camera, source=str(seen.videos[entry.left]),
        )  # fmt: skip
        return video, rectifier.camera

    def accuracy(self, take: Take) -> dict[str, float]:
        """Standard deviation of every sensor, [m] or [px]; of stereo at two thirds of its range."""
        out = {entry.name: entry.sigma for entry in take.depth}
        for stereo in take.stereo:
            video = next(v for v in self.depth if v.sensor == stereo.name)
            assert video.camera is not None
            left, right = self.rig[stereo.left], self.rig[stereo.right]
            baseline = float(np.linalg.norm(left.centre_world - right.centre_world))
            z = 0.67 * stereo.range[1]
            out[stereo.name] = stereo.sigma * z**2 / (video.camera.matrix[0, 0] * baseline)
        out |= {f"silhouette {entry.camera}": entry.sigma for entry in take.silhouettes}
        out |= {entry.camera: entry.sigma for entry in take.keypoints}
        return out | {f"markers {k}": entry.sigma for k, entry in enumerate(take.markers)}

    def at(self, i: int, body: Body) -> list[Frame]:
        """Frames of step `i` of the take; of keypoints the person that is followed."""
        seen, out = self.seen, list[Frame]()
        step = seen.frames[0] + i
        recordings: tuple[DepthVideo | CloudVideo | SilhouetteVideo, ...] = (
            *self.depth, *seen.clouds, *self.silhouettes,
        )  # fmt: skip
        for recording in recordings:
            k = recording.at_step(step, seen.rate)
            if k is not None:
                out.append(recording.frame(k))
        for keypoints, people in zip(seen.keypoints, self.people):
            frame = self._keypoints(keypoints, people, i, step / seen.rate)
            if frame is not None:
                out.append(frame)
        for k, (markers, given, offset) in enumerate(zip(seen.markers, self._sets, self._offsets)):
            frame_number = round((step / seen.rate - offset) * markers.rate)
            if 0 <= frame_number < len(markers):
                out.append(_markers(markers, frame_number, f"markers {k}", body, given, step / seen.rate))
        return out

    @staticmethod
    def _keypoints(keypoints: Keypoints, people: NDArray, i: int, time: float) -> KeypointFrame | None:
        if i >= len(keypoints) or people[i] < 0:
            return None
        uv, confidence = keypoints.points[i, people[i]], keypoints.confidence[i, people[i]]
        return KeypointFrame(keypoints.camera, time, keypoints.names, uv, confidence, keypoints.keypoint_set)

    def first_depth(self) -> tuple[DepthVideo, dict[int, DepthFrame]] | None:
        """The first depth sensor, and some of its images from the beginning of the take, by step."""
        start, stop = self.seen.frames
        for video in self.depth:
            frames = {s - start: k for s in range(start, stop) if (k := video.at_step(s, self.seen.rate)) is not None}
            first = [step for step in frames if step <= min(frames) + _FIRST * self.seen.rate]
            if first:
                chosen = np.linspace(0, len(first) - 1, min(_SIZES, len(first))).astype(int)
                return video, {first[c]: video.frame(frames[first[c]]) for c in chosen}
        return None


def _markers(
    markers: Markers, frame: int, sensor: str, body: Body, given: str | None, time: float
) -> MarkerFrame:
    own = known_set(body, markers.names, given)
    known = body.markers(own) if own else body.landmarks
    names = tuple(n or bare(label) for label, n in zip(markers.names, matched(markers.names, known.names)))
    return MarkerFrame(sensor, time, names, markers.positions[frame], own)


def _sized(body: Body, take: Take, source: FrameSource, up: NDArray, progress: Progress | None) -> Sized:
    """The body in the person's size: by keypoints of two cameras where there are, else by depth."""
    seen = source.seen
    if len({k.camera for k in seen.keypoints}) >= 2:
        accuracy = [entry.sigma for entry in take.keypoints]
        channels = make_channels(body, source.rig, seen.keypoints, source.people, accuracy)
        subject = fit_subject(body, channels, height=take.height, progress=progress)
        return Sized(subject.body, told={"length_std_m": subject.length_std})
    if take.height:
        body = body.scaled(np.full(len(body.scale_groups), take.height / body.stature))
    shown = source.first_depth()
    if shown is None:
        return Sized(body, told={"size": "as told" if take.height else "of the catalogue"})
    video, frames = shown
    if progress:
        progress("size", 0, 1)
    found = sized_by_depth(body, frames, source.rig[video.sensor], up)
    if progress:
        progress("size", 1, 1)
    return found
