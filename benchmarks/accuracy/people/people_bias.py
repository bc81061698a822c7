"""Bias by keypoint and direction of view: found in the take itself, and as a table out of other recordings.

Each camera is left out in turn: the body, and the bias, are fitted to the others; what counts is the median distance of
the left-out camera's keypoints from where both put them, over that without any bias. A table of the built-in detector's
network is learnt from two recordings and tried on the third (other people, other cameras). Standard deviations of the
bias were chosen among 1, 1.4 and 2 cm on the built-in detector's three recordings; OpenPose had no part in it.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from benchmarks.accuracy.video.tracking import read_trial
from benchmarks.figures import LEFT_OUT, data, figure, quick
from benchmarks.scenes.held_out import cameras_left_out, median, persons, sides_right
from benchmarks.scenes.takes import seen_of
from kinefit import (
    Keypoints,
    Motion,
    Recording,
    Rig,
    TrackSettings,
    load_body,
    read_calibration,
    track,
)
from kinefit.errors import AssetError, ObservationError
from kinefit.fitting.subject.keypoints import SeenFrames, fit_subject, learn_view_bias
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.observations import MEDIAPIPE_33
from kinefit.readers.landmarks.keypoints import read_caliscope_csv
from kinefit.sensors.points.views import ViewBias
from kinefit.takes.preparing import detecting

_OWN, _TABLE = "x that without, bias found in the take", "x that without, bias of the other two recordings"
_TAKES = "openpose", "mediapipe", "balancing", "seated", "cropped"
_SAME_NETWORK = "balancing", "seated", "cropped"
_PLAIN = TrackSettings(view_bias=False)
_BODY = load_body("humanoid")


@dataclass(frozen=True)
class Seen:
    """One person's keypoints in all cameras."""

    rig: Rig
    people: list[Keypoints]

    def without(self, camera: str) -> Recording:
        """What the other cameras saw."""
        return Recording.of_keypoints(self.rig, [k for k in self.people if k.camera != camera])

    def held_out(self, settings: TrackSettings | None = None) -> float:
        """[px] of a track."""
        errors = cameras_left_out(self.rig, self.people, lambda c: track(self.without(c), _BODY, settings=settings))
        return median(errors)

    def held_out_with(self, table: ViewBias) -> float:
        """[px] of a track that knows a bias."""
        return median(cameras_left_out(self.rig, self.people, partial(self._knowing, table)))

    def _knowing(self, table: ViewBias, camera: str) -> Motion:
        recording = self.without(camera)
        channels = channels_of(recording, _BODY, _PLAIN)
        subject = fit_subject(_BODY, channels, cameras=_PLAIN.camera_errors)
        return track(recording, _BODY, subject=replace(subject, view_bias=table), settings=_PLAIN)

    def frames(self) -> SeenFrames:
        """Of all cameras, at the poses that they give together."""
        motion = track(Recording.of_keypoints(self.rig, self.people), _BODY, settings=_PLAIN)
        channels, _ = sides_right(motion, self.rig, self.people)
        states = [motion.state(f) for f in range(len(motion))]
        return SeenFrames(motion.body, channels, states, channels.uv, channels.confidence)


def run() -> None:
    """Print every figure."""
    with tempfile.TemporaryDirectory() as where:
        reason = LEFT_OUT if quick() else ""
        takes: dict[str, Seen] = {}
        if not reason:
            try:
                takes = _takes(Path(where))
            except (AssetError, ObservationError) as error:
                reason = error.problem
        plain = {name: take.held_out(_PLAIN) for name, take in takes.items()}
        for name in _TAKES:
            value = None
            if name in takes:
                px = takes[name].held_out()
                print(f"# {name}: a camera left out {plain[name]:.2f} px, with the bias found in the take {px:.2f} px")
                value = px / plain[name]
            figure(f"people_bias_take_{name}", value, _OWN, "<= 1", reason or "no recording")
        frames = {name: takes[name].frames() for name in _SAME_NETWORK if name in takes}
        for name in _SAME_NETWORK:
            others = [one for other, one in frames.items() if other != name]
            value = None
            if name in frames and others:
                px = takes[name].held_out_with(learn_view_bias(others))
                print(f"# {name}: a camera left out {plain[name]:.2f} px, with the others' table {px:.2f} px")
                value = px / plain[name]
            figure(f"people_bias_table_{name}", value, _TABLE, "<= 1", reason or "no recording")


def _takes(where: Path) -> dict[str, Seen]:
    """By name, those of which the recording is there."""
    out = {}
    trial, seated, cropped = map(data, ("video_balancing_4cam", "mv4_upperbody_caliscope", "mv4_landmarks_caliscope"))
    if trial is not None:
        for detector in ("openpose", "mediapipe"):
            read = read_trial(trial, detector, where)
            out[detector] = Seen(read.rig, persons(read.rig, read.keypoints))
        videos = {f"cam0{c}": f"{trial}/videos/cam0{c}.mp4" for c in range(1, 5)}
        out["balancing"] = _detected(f"{trial}/Calib_refined_static.toml", videos, 60.0, boxed=2)
    if seated is not None:
        videos = {f"cam_{c}": f"{seated}/port_{c}.mp4" for c in range(4)}
        out["seated"] = _detected(f"{seated}/config.toml", videos, 6.0)
    if cropped is not None:
        rig = read_calibration(cropped / "config.toml")
        ports = read_caliscope_csv(cropped / "HOLISTIC" / "xy_HOLISTIC.csv", rate=24.0)
        poses = [one.first_points("MEDIAPIPE_33", MEDIAPIPE_33) for one in ports.values()]
        keypoints = [replace(one, camera=name) for name, one in zip(rig.names, poses, strict=True)]
        out["cropped"] = Seen(rig, persons(rig, keypoints))
    return out


def _detected(calibration: str, videos: dict[str, str], rate: float, boxed: int = 0) -> Seen:
    """By the built-in detector; the first so many videos are letterboxed."""
    detecting.networks(None, print)
    text = f'[take]\nrate = {rate}\n[calibration]\nfile = "{calibration}"\nunit = "m"\n'
    for k, (name, video) in enumerate(videos.items()):
        text += f'[[camera]]\nname = "{name}"\nvideo = "{video}"\n' + 'image = "letterboxed"\n' * (k < boxed)
    seen = seen_of(text, detect=True)
    assert seen.rig is not None
    return Seen(seen.rig, persons(seen.rig, seen.keypoints))
