"""Detections of quality `auto`, which looks at some images, beside those of `best`, which looks at all.

Four cameras (the balancing trial), two people before the same four, and one camera against markers: processor time of
detection, joints and angles of the motion against those of every look, people who are kept. Simulated: recorded motions
before four cameras whose points err by 3 px of jitter and 2 px that last half a second, all images and every fourth:
joints against the truth, and the share of them inside their 95 % intervals.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.people import people_one_camera as markers
from benchmarks.accuracy.uncertainty.error_bars import ACCURACY, mean
from benchmarks.figures import NotMeasured, amount, each, figure, quick, recording, whole_recording
from benchmarks.scenes.motions import library
from benchmarks.scenes.simulated import somebody
from kinefit import Keypoints, Motion, Recording, load_body, track
from kinefit.images.detectors.detection import LOOK_RATE
from kinefit.observations import Detections
from kinefit.readers.assets import CAMERAS
from kinefit.readers.landmarks.detections import read_detections
from kinefit.readers.take.file import read_take
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import coverage_of_groups
from kinefit.takes.in_view import people_in_view
from kinefit.takes.preparing import detecting
from kinefit.takes.track import track_take

_QUALITIES = "best", "auto"
_MOTIONS = ["walk 02_01", "jumping jacks 13_30", "wash 02_10", "brisk walk 007_12"]
_FRAMES = 240  # of a simulated motion


@dataclass(frozen=True, eq=False)
class Detected:
    """Detections of one quality, their processor time [s], and the take that has them."""

    files: dict[str, Detections]
    seconds: float
    take: Path


def run() -> None:
    """Print every figure."""
    each(_four, _two_people, _one, _simulated)


def _detected(folder: Path, quality: str, head: str, videos: dict[str, Path], camera: str = "") -> Detected:
    """The videos of a take through the detector; `head` and `camera` are lines of its file."""
    where = folder / quality
    where.mkdir()
    text = f"[take]\n{head}"
    text += "".join(f'[[camera]]\nname = "{c}"\nvideo = "{video}"\n{camera}' for c, video in videos.items())
    take = where / "take.toml"
    take.write_text(text)
    jobs = detecting.jobs_of_take(read_take(take))
    jobs = [replace(job, seconds=amount(None, (0.0, 0.5))) for job in jobs]
    began = time.process_time()
    detecting.detect(jobs, detecting.DetectionSettings(masks=False, quality=quality), tell=print)
    seconds = time.process_time() - began
    seen = "".join(f'[[keypoints]]\ncamera = "{c}"\nformat = "detect"\nfile = "take-detect/{c}.npz"\n' for c in videos)
    take.write_text(text + seen)
    return Detected({job.camera: read_detections(job.file) for job in jobs}, seconds, take)


def _both(folder: str, *given: object) -> tuple[Detected, Detected]:
    """With every look, and with some; the networks are loaded before."""
    detecting.networks(None, print, "best")
    every, some = (_detected(Path(folder), quality, *given) for quality in _QUALITIES)  # type: ignore[arg-type]
    looks = [f.looked.sum() if f.looked is not None else len(f) for f in some.files.values()]
    print(f"# looked at {', '.join(map(str, looks))} of {', '.join(str(len(f)) for f in some.files.values())} images; "
          f"{every.seconds:.1f} s of processor, {some.seconds:.1f} s with some looks", flush=True)  # fmt: skip
    return every, some


def _apart(every: Motion, some: Motion) -> tuple[NDArray, NDArray]:
    """Joints [mm] and angles [degrees] of two motions from each other."""
    joints = 1e3 * np.linalg.norm(some.joint_centres - every.joint_centres, axis=-1)
    return joints, np.degrees(np.abs(np.angle(np.exp(1j * (some.angles - every.angles)))))


def _figures(name: str, every: Detected, some: Detected, motions: list[Motion]) -> None:
    joints, angles = _apart(*motions)
    lost = [100 * float(m.lost.mean()) for m in motions]
    sigma = np.linalg.norm(motions[0].joint_std, axis=-1)
    print(f"# {name}: joints 95 % {np.percentile(joints, 95):.1f} mm of their sigma of "
          f"{1e3 * np.median(sigma):.0f} mm, lost {lost[0]:.2f} and {lost[1]:.2f} %", flush=True)  # fmt: skip
    figure(f"looking_{name}_time", every.seconds / some.seconds, "times less processor time", ">= 2.5")
    figure(f"looking_{name}_joints", float(np.median(joints)), "mm, median to every look", "<= 0.5")
    figure(f"looking_{name}_angles", float(np.median(angles)), "degrees, median to every look", "<= 0.2")
    figure(f"looking_{name}_lost", lost[1] - lost[0], "% more segments lost", "<= 0.1")


def _four() -> None:
    trial = recording("video_balancing_4cam")
    head = f'up = "z"\n[calibration]\nfile = "{trial}/Calib_refined_static.toml"\nunit = "m"\n'
    videos = {c: trial / "videos" / f"{c}.mp4" for c in CAMERAS}
    with tempfile.TemporaryDirectory() as folder:
        every, some = _both(folder, head, videos, 'image = "letterboxed"\n')
        _figures("four", every, some, [track_take(one.take)[0] for one in (every, some)])


def _two_people() -> None:
    trial = whole_recording("video_two_people_4cam")
    head = f'[calibration]\nfile = "{trial}/Calib.qca.txt"\n'
    with tempfile.TemporaryDirectory() as folder:
        every, some = _both(folder, head, {c: trial / f"{c}.mp4" for c in CAMERAS})
        views = [people_in_view(read_take(one.take)) for one in (every, some)]
    kept = 0
    for camera, all_seen in every.files.items():
        seen = some.files[camera]
        looked = np.ones(len(seen), bool) if seen.looked is None else seen.looked
        kept += int((seen.seen[looked].sum(axis=1) >= all_seen.seen[looked].sum(axis=1)).sum() == looked.sum())
    counts = [0 if view is None else len(view.people) for view in views]
    print(f"# people in view: {counts[0]} with every look, {counts[1]} with some", flush=True)
    figure("looking_two_time", every.seconds / some.seconds, "times less processor time", ">= 2.5")
    figure("looking_two_people", float(counts[1]), "people followed", "== 2")
    figure("looking_two_kept", float(kept), "cameras that miss nobody in any image looked at", "== 4")


def _one() -> None:
    trial = whole_recording("video_mono_opencap") / "STS"
    times, truth = markers.joints_of_file(trial / "sample_mocap.json")
    head = f"height = {markers.stature(truth):.2f}\n"
    with tempfile.TemporaryDirectory() as folder:
        every, some = _both(folder, head, {"cam": trial / "video.mp4"})
        motions = [track_take(one.take)[0] for one in (every, some)]
    _figures("one", every, some, motions)
    found = [markers.against(m.times, markers.joints_of(m, 1.0), times, truth, markers.std_of(m)) for m in motions]
    for name in ("relative", "absolute", "knee", "inside_least", "inside_most"):
        first, second = (one[f"one_camera_{name}"] for one in found)
        print(f"# against markers, {name}: {first:.1f} with every look, {second:.1f} with some", flush=True)
    ratio = found[1]["one_camera_relative"] / found[0]["one_camera_relative"]
    figure("looking_one_markers", ratio, "of the error of every look, against markers", "<= 1.02")


def _sparse(records: list[Keypoints]) -> list[Keypoints]:
    step = round(records[0].rate / LOOK_RATE)
    looked = np.arange(len(records[0])) % step == 0
    looked[-1] = True
    return [replace(record.without(~looked), looked=looked) for record in records]


def _simulated() -> None:
    motions = library(None if quick() else _MOTIONS)
    if not motions:
        raise NotMeasured("the recorded motions are absent")
    errors, joints, angles, inside = list[float](), list[float](), list[float](), list[list[float]]()
    for number, (name, whole) in enumerate(motions.items()):
        truth = somebody(whole.part(slice(0, _FRAMES)), "MEDIAPIPE_33", np.random.default_rng(number))
        rig = studio_rig(truth)
        seen = simulate_keypoints(truth, rig, "MEDIAPIPE_33", drift_px=2.0, seed=number)
        found = [
            track(Recording.of_keypoints(rig, records, sigma=ACCURACY, up=truth.up), load_body("humanoid"))
            for records in (seen, _sparse(seen))
        ]
        off = [np.linalg.norm(m.joint_centres - truth.joint_centres, axis=-1).mean() for m in found]
        share = [mean(tuple(one.joints for one in coverage_of_groups(truth, m).values())) for m in found]
        apart = _apart(*found)
        errors.append(off[1] / off[0])
        joints.append(np.median(apart[0]))
        angles.append(np.median(apart[1]))
        inside.append(share)
        print(f"# {name}: joints off by {1e3 * off[0]:.1f} mm and {1e3 * off[1]:.1f} mm, "
              f"inside {100 * share[0]:.0f} and {100 * share[1]:.0f} %", flush=True)  # fmt: skip
    figure("looking_rooms_joints", float(np.mean(joints)), "mm, median to every look", "<= 0.5")
    figure("looking_rooms_angles", float(np.mean(angles)), "degrees, median to every look", "<= 0.2")
    figure("looking_rooms_error", float(np.mean(errors)), "of the error of every look, against the truth", "<= 1.02")
    least = 100 * float(np.min([some - every for every, some in inside]))
    figure("looking_rooms_inside", least, "% more joints in 95 % intervals, the least", ">= -1")
