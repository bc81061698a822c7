"""A whole answer of another program as `[[pose]]`: alone, and with the video that it was made of; against markers.

The files are OpenCap Monocular's of `video_mono_opencap`, compared by the lines of `people_one_camera`: joints against
the pelvis, both programs laid on the markers once. Settings were chosen on STS, which the figures are of; `walk_ts` is
printed apart, alone: its video is not on the clock of its file. No stature is stated where there is no video.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from benchmarks.accuracy.people import people_one_camera as lines
from benchmarks.commands import ended
from benchmarks.figures import NotMeasured, data, figure, quick
from kinefit import read_motion
from kinefit.errors import AssetError, ObservationError
from kinefit.takes.preparing import detecting

_RATE = 30.0  # [Hz] of the takes: the person sits down and rises
_GOALS = {
    "second_opinion_alone_gain": ("% nearer to the markers than the file, joints against the pelvis, STS", ">= 20"),
    "second_opinion_both": ("mm, joints against the pelvis, with the video, STS", "<= 36"),
    "second_opinion_both_gain": ("% nearer than the better of file and video alone, STS", "> 0"),
    "second_opinion_inside_least": ("% of coordinates in 95 % intervals, least of axes, alone and both, STS", ">= 90"),
    "second_opinion_inside_most": ("% of coordinates in 95 % intervals, most of axes, alone and both, STS", "<= 98"),
}  # fmt: skip


def run() -> None:
    """Print every figure."""
    root = data("video_mono_opencap")
    if root is None:
        raise NotMeasured("no recording")
    found = dict[str, float]()
    for trial in ("walk_ts",) if quick() else lines.TRIALS[::-1]:
        before = lines.against(*lines.joints_of_file(root / trial / "sample_mono.json"), *_markers(root / trial))
        alone = _tracked(root / trial, pose=True)
        print(f"{trial}, OpenCap Monocular: {_line(before)}\n{trial}, its file alone: {_line(alone)}", flush=True)
        found["second_opinion_alone_gain"] = 100.0 * (1.0 - _relative(alone) / _relative(before))
    why = "the quick form has no video"
    if not quick():
        try:
            detecting.networks(None, print)
        except (AssetError, ObservationError) as error:
            raise NotMeasured(error.problem) from error
        video, both = (_tracked(root / "STS", video=True, pose=pose) for pose in (False, True))
        print(f"STS, the video alone: {_line(video)}\nSTS, both: {_line(both)}", flush=True)
        better = min(_relative(video), _relative(alone), _relative(before))
        found["second_opinion_both"] = _relative(both)
        found["second_opinion_both_gain"] = 100.0 * (1.0 - _relative(both) / better)
        for end, of in (("least", min), ("most", max)):
            found[f"second_opinion_inside_{end}"] = of(one[f"one_camera_inside_{end}"] for one in (alone, both))
    for name, (unit, goal) in _GOALS.items():
        figure(name, found.get(name), unit, goal, why)


def _markers(trial: Path) -> tuple:
    return lines.joints_of_file(trial / "sample_mocap.json")


def _tracked(trial: Path, *, video: bool = False, pose: bool = False) -> Mapping[str, float]:
    """Figures of `kinefit track` on the take that `kinefit init` makes of these files."""
    times, truth = _markers(trial)
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        if video:
            shutil.copy(trial / "video.mp4", folder)
        if pose:
            shutil.copy(trial / "sample_mono.json", folder)
        ended("init", folder, check=True)
        take = folder / "take.toml"
        text = take.read_text().replace("# height = 1.75", f"height = {lines.stature(truth):.2f}  #" if video else "#")
        rows = [line for line in text.splitlines() if not line.startswith("rate =")]
        take.write_text("\n".join(rows).replace("[take]", f"[take]\nrate = {_RATE}", 1) + "\n")
        ended("track", take, "--pictures", "none", "--no-report", check=True)
        motion = read_motion(folder / "take-kinefit" / "motion.npz")
    scale = json.loads((trial / "sample_mocap.json").read_text())["bodies"]["pelvis"]["scaleFactors"][0]
    return lines.against(motion.times, lines.joints_of(motion, scale), times, truth, lines.std_of(motion))


def _relative(found: Mapping[str, float]) -> float:
    return found["one_camera_relative"]


def _line(found: Mapping[str, float]) -> str:
    return ", ".join(f"{k.removeprefix('one_camera_')} {v:.3g}" for k, v in found.items() if v == v)
