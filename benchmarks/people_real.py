"""Two people in four real videos: two tracks through `track`'s own way in, and the man as he is without the woman."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import data, figure, quick
from kinefit import load_body
from kinefit.errors import AssetError, ObservationError
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import Observations, load_observations
from kinefit.readers.videos.video import Video
from kinefit.takes.in_view import people_in_view
from kinefit.takes.missing import prepared
from kinefit.takes.preparing import detecting
from kinefit.takes.track import track_take

_GOALS = {
    "people_two_tracks": ("people", "== 2"), "people_two_frames": ("% of the frames, the one seen least", ">= 99"),
    "people_man_median": ("mm", "<= 10"), "people_man_95": ("mm", "<= 25"),
    "people_woman_residual": ("px, the worst camera", "<= 12"),
}  # fmt: skip
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
_FAR = 30.0  # px, pictures are not moved further: what matches beyond is no match
_LAGS, _MOVING = 2, 25.0  # frames looked at before and after; grey values by which a pixel changes where he moves
ACCURACY = 8.0  # px, as `kinefit track` takes it for the built-in detector


def run() -> None:
    """Print every figure."""
    two, one = data("video_two_people_4cam"), data("video_balancing_4cam")
    try:
        detecting.networks(None, print)
        missing = "left out of the quick form: eight videos are looked through" if quick() else ""
    except (AssetError, ObservationError) as error:
        missing = error.problem
    if two is None or one is None:
        missing = "no recording"
    if missing or two is None or one is None:
        for name, (unit, goal) in _GOALS.items():
            figure(name, None, unit, goal, missing)
        return
    with tempfile.TemporaryDirectory() as folder:
        _both(two, one, Path(folder))


def take_of(videos: Path, calibration: Path, folder: Path, image: str = "") -> Path:
    """A take file of four videos, in a new folder."""
    folder.mkdir()
    text = f'[take]\nrate = 60.0\n[calibration]\nfile = "{calibration}"\n'
    text += "".join(f'[[camera]]\nname = "{c}"\nvideo = "{videos / c}.mp4"\n{image}' for c in CAMERAS)
    (folder / "take.toml").write_text(text)
    return folder / "take.toml"


def _both(two: Path, one: Path, folder: Path) -> None:
    calibration = two / "Calib.qca.txt"
    together = prepared(read_take(take_of(two, calibration, folder / "two")))
    by_himself = prepared(read_take(take_of(one / "videos", calibration, folder / "one", 'image = "letterboxed"\n')))
    view = people_in_view(together)
    assert view is not None
    people = view.people
    _figure("people_two_tracks", float(len(people)))
    frames = [float(np.mean(p.views > 0)) for p in people]
    _figure("people_two_frames", 100 * min(frames))
    print(f"# cameras a frame: {', '.join(f'{p.views.mean():.2f}' for p in people)}")
    motions = [track_take(replace(together, person=k + 1))[0] for k in range(len(people))]
    man = int(np.argmax([p.speed for p in people]))
    seen, alone = load_observations(together), load_observations(by_himself)
    shift = {c: _shift(seen, alone, c) for c in CAMERAS}
    lags = {c: _lag(seen, alone, c, shift[c]) for c in CAMERAS}
    print(f"# the pictures were moved by {', '.join(f'{c} {v.round(1).tolist()}' for c, v in shift.items())} px, "
          f"and come {', '.join(f'{c} {v}' for c, v in lags.items())} frames later")  # fmt: skip
    lag = round(float(np.median(list(lags.values()))))
    assert seen.rig is not None and alone.rig is not None
    moved = []
    for k in seen.keypoints:  # as if her pictures were his, but for a constant shift
        pixels = seen.images[k.camera].from_calibration(k.points) - shift[k.camera]
        moved.append(replace(k, points=alone.images[k.camera].to_calibration(pixels)))
    with_her = track(Recording.of_keypoints(seen.rig, moved, sigma=ACCURACY, person=man + 1), load_body("humanoid"))
    without = track(Recording.of_keypoints(alone.rig, alone.keypoints, sigma=ACCURACY), load_body("humanoid"))
    for name, motion in (("as they are", motions[man]), ("moved back", with_her)):
        a, b = motion.segment_poses()[max(lag, 0) :, :, :3, 3], without.segment_poses()[max(-lag, 0) :, :, :3, 3]
        count = min(len(a), len(b))
        gap = 1e3 * np.linalg.norm(a[:count] - b[:count], axis=-1)
        print(f"# the man's joints with her in view, pictures {name}: median {np.median(gap):.1f}, 95th "
              f"{np.percentile(gap, 95):.1f} mm")  # fmt: skip
    _figure("people_man_median", float(np.median(gap)))
    _figure("people_man_95", float(np.percentile(gap, 95)))
    print("# the woman is drawn into each picture by itself: no pose of hers fits all four cameras; not refined")
    residuals = [float(np.nanmedian(r.norms)) for r in motions[1 - man].residuals.values()]
    _figure("people_woman_residual", max(residuals))


def _shift(seen: Observations, alone: Observations, camera: str) -> NDArray:
    """(2,) [px] by which one recording's pictures are moved against the other's: of what does not move in either."""
    background = []
    for one in (seen, alone):
        with Video(one.videos[camera]) as video:
            grey = [cv2.cvtColor(video.read(f), cv2.COLOR_BGR2GRAY) for f in range(0, len(video), 10)]
        background.append(np.median(grey, axis=0).astype(np.uint8))
    points, features = zip(*(cv2.ORB.create(4000).detectAndCompute(b, None) for b in background))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, True).match(*features)
    moved = np.array([np.subtract(points[0][m.queryIdx].pt, points[1][m.trainIdx].pt) for m in pairs])
    return np.median(moved[np.linalg.norm(moved, axis=1) < _FAR], axis=0)


def _lag(seen: Observations, alone: Observations, camera: str, shift: NDArray) -> int:
    """How many frames later one recording shows what the other does: by the pixels that move in the other."""
    with Video(seen.videos[camera]) as first, Video(alone.videos[camera]) as second:
        off = dict.fromkeys(range(-_LAGS, _LAGS + 1), 0.0)
        for f in range(2 * _LAGS, min(len(first), len(second)) - 2 * _LAGS, 6):
            u, v = np.round(shift).astype(int)
            with_her = np.roll(first.read(f).astype(float).mean(axis=2), (-v, -u), axis=(0, 1))
            near = {lag: second.read(f - lag).astype(float).mean(axis=2) for lag in off}
            h, w = np.minimum(with_her.shape, near[0].shape)
            moving = np.abs(near[_LAGS] - near[-_LAGS])[:h, :w] > _MOVING
            for lag, picture in near.items():  # the median: where she stands nothing fits
                off[lag] += float(np.median(np.abs(with_her[:h, :w] - picture[:h, :w])[moving]))
    return min(off, key=lambda lag: off[lag])


def _figure(name: str, value: float) -> None:
    figure(name, value, *_GOALS[name])
