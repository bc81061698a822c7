"""Videos that dropped frames and cameras of unequal rates, through `kinefit init` and a track with defaults.

The balancing trial's four videos are copied without some of their frames; those that stay keep their times. The
motion is compared with that of copies with all frames, at the same times: how far joints lie apart on average.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

from benchmarks.figures import data, figure, quick
from kinefit import Motion, track_take
from kinefit.errors import AssetError, ObservationError
from kinefit.readers.assets import CAMERAS
from kinefit.readers.guess.folder import guess_take
from kinefit.takes.preparing import detecting

_GOALS = {"phones_variable_rate": "<= 5", "phones_unequal_rates": "<= 8"}
_CALIBRATION = "Calib_refined_static.toml"
_ENCODED = {"preset": "superfast", "crf": "12"}  # so good that the detector sees the same
Keep = Callable[[int, int], bool]
"""Whether frame i of a video of n frames stays."""


def run() -> None:
    """Print every figure."""
    trial, missing = data("video_balancing_4cam"), "no recording"
    try:
        detecting.networks(None, print)
    except (AssetError, ObservationError) as error:
        trial, missing = None, error.problem
    if trial is None or quick():
        for name, goal in _GOALS.items():
            figure(name, None, "mm", goal, missing if trial is None else "left out of the quick form")
        return
    with tempfile.TemporaryDirectory() as folder:
        whole = _tracked(trial, Path(folder) / "whole", {})
        all_lost = _tracked(trial, Path(folder) / "all", dict.fromkeys(CAMERAS, _without_middle))
        one_lost = _tracked(trial, Path(folder) / "one", {CAMERAS[1]: _without_middle})
        slow = _tracked(trial, Path(folder) / "slow", dict.fromkeys(CAMERAS[1::2], lambda i, n: i % 2 == 0))
    lost = [_apart(whole, motion) for motion in (all_lost, one_lost)]
    print(f"  a middle third without every second frame: in all four videos {lost[0]:.2f} mm, in one {lost[1]:.2f} mm")
    figure("phones_variable_rate", max(lost), "mm", _GOALS["phones_variable_rate"])
    figure("phones_unequal_rates", _apart(whole, slow), "mm", _GOALS["phones_unequal_rates"])


def _without_middle(i: int, n: int) -> bool:
    return not (n // 3 <= i < 2 * n // 3 and i % 2 == 1)


def _tracked(trial: Path, folder: Path, keep: dict[str, Keep]) -> Motion:
    """The motion of copies of the trial's videos without frames that are not kept."""
    folder.mkdir()
    (folder / _CALIBRATION).write_bytes((trial / _CALIBRATION).read_bytes())
    for camera in CAMERAS:
        _copy(trial / "videos" / f"{camera}.mp4", folder / f"{camera}.mp4", keep.get(camera, lambda i, n: True))
    guess = guess_take(folder)
    for note in guess.notes:
        print(f"  {folder.name}: {note.sure} {note.about}: {note.text}")
    (folder / "take.toml").write_text(guess.text, "utf-8")
    return track_take(folder / "take.toml")[0]


def _copy(video: Path, copy: Path, keep: Keep) -> None:
    """Write the frames of a video that are kept, with the times they have."""
    with av.open(str(video)) as source, av.open(str(copy), "w") as target:
        given = source.streams.video[0]
        stream = target.add_stream("libx264", rate=given.average_rate, options=_ENCODED)
        stream.width, stream.height, stream.pix_fmt = given.width, given.height, "yuv420p"
        stream.codec_context.time_base = given.time_base
        for i, frame in enumerate(source.decode(given)):
            if keep(i, given.frames):
                frame.pict_type = 0
                target.mux(stream.encode(frame))
        target.mux(stream.encode())


def _apart(whole: Motion, motion: Motion) -> float:
    """Mean distance [mm] of joints at the times that both motions have."""
    at, other = (np.rint(m.times * whole.rate).astype(int) for m in (whole, motion))
    _, mine, theirs = np.intersect1d(at, other, return_indices=True)
    x, y = whole.joint_centres[mine], motion.joint_centres[theirs]
    each = 1e3 * np.linalg.norm(x - y, axis=2).mean(axis=1)
    worst = whole.times[mine[each.argmax()]]
    print(f"  {len(mine)} of {len(whole)} frames, the worst {each.max():.1f} mm at {worst:.2f} s")
    return float(each.mean())
