"""Images against what the take says of them: black bars, covered lenses, noise of depth cameras."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from kinefit.observations import MEDIAPIPE_33, Keypoints
from kinefit.readers.take.entries import CameraEntry, DepthEntry
from kinefit.readers.take.load import Observations
from kinefit.rigs.diagnostics.images import fit_image, noise_findings, without_covered
from kinefit.simulation import DepthSensor, in_front, simulate_depth, squat_and_wave


@pytest.fixture
def video(tmp_path):
    """A folder of images of 200 x 200 px with bars of so many px above and below."""

    def draw(bars):
        image = np.full((200, 200, 3), 180, np.uint8)
        image[:bars] = image[200 - bars :] = 0
        for k in range(3):
            cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        return tmp_path

    return draw


@pytest.mark.parametrize(
    ("said", "bars", "found", "remedy"),
    [
        ("scaled", 20, ("fault", "letterboxed"), 'Write image = "letterboxed" into [[camera]] a.'),
        ("letterboxed", 0, ("fault", "picture"), 'Write image = "scaled" into [[camera]] a.'),
        ("letterboxed", 45, ("doubt", "picture"), 'Try image = "scaled" in [[camera]] a.'),  # a dark scene
        ("letterboxed", 20, ("note", "letterboxed"), ""),
        ("scaled", 0, ("note", "picture"), ""),
        ("as calibrated", 20, ("fault", "letterboxed"), 'Write image = "letterboxed" into [[camera]] a.'),
    ],
)
def test_bars_contradict_what_the_take_says(video, said, bars, found, remedy):
    entry = CameraEntry(name="a", video=video(bars), image=said)
    fitting, findings = fit_image(entry, (400, 320), 30.0, frames=1)
    assert [(f.severity, f.kind) for f in findings] == [found]
    assert findings[0].cameras == ("a",) and findings[0].remedy == remedy
    assert fitting.image == ("letterboxed" if found == ("fault", "letterboxed") else said)


ROOM = DepthSensor("depth", (80, 60), 68.0, 0.5, 5.5, (0.004, 0.0008, 0.0), holes=0.01)
NONE = SimpleNamespace(rate=10.0, cameras=(), depth=())


@pytest.fixture(scope="module")
def depth():
    """3 s of rendered depth images of a person in a room, at 10 Hz."""
    motion = squat_and_wave(rate=10.0, duration=3.0, up="y")
    front = in_front(motion, ROOM.camera(), azimuth=0.3, near=ROOM.near, far=ROOM.far)
    video = simulate_depth(motion, front, ROOM, seed=1)
    images = [video.frame(i).depth for i in range(len(video))]
    return replace(video, image=lambda i: images[i].copy())


def changed(video, frames, change):
    """A depth recording with some images changed: change(image, random numbers of the same size, generator)."""
    def image(i):
        random = np.random.default_rng(i)
        return change(video.image(i), random.random(video.size[::-1]), random) if i in frames else video.image(i)

    return replace(video, image=image)


def seen_by(*videos, keypoints=(), paths=None):
    images = {k.camera: None for k in keypoints}
    return Observations(10.0, (0, 30), None, keypoints, (), paths or {}, images, depth=videos)


ON_LENS = {
    "holes": lambda depth, random, _: 0.0 * depth,
    "a hand": lambda depth, random, _: np.where(random < 0.6, 0.51 + 0.05 * random, 0.0),
}


@pytest.mark.parametrize("how", ON_LENS)
@pytest.mark.parametrize("frames", [range(8, 15), range(4), range(25, 30)])
def test_a_covered_depth_camera_is_named_with_its_time_and_its_images_are_left_out(depth, frames, how):
    other = replace(depth, sensor="other")
    seen, (found,) = without_covered(NONE, seen_by(other, changed(depth, frames, ON_LENS[how])))
    assert (found.severity, found.kind, found.cameras) == ("doubt", "covered", ("depth",))
    assert f"lens of depth is probably covered from {frames[0] / 10:.2f} to {frames[-1] / 10:.2f} s" in found.text
    left = [k for k in range(30) if seen.depth[1].at_step(k, 10.0) is not None]
    assert seen.depth[0] is other and left == [k for k in range(30) if k not in frames]
    np.testing.assert_array_equal(seen.depth[1].frame(left.index(20)).depth, depth.frame(20).depth)


def test_no_depth_camera_is_called_covered_that_is_not(depth):
    gone = range(10, 20)
    alone = changed(depth, range(30), lambda d, *_: np.where(d < 2.6, d, 0.0))  # sees who is near and nothing else
    left = changed(alone, gone, ON_LENS["holes"])
    half = changed(depth, gone, lambda d, *_: d * (np.arange(80) < 30))
    body = replace(changed(depth, gone, ON_LENS["holes"]), on_body=True)
    single = changed(depth, range(12, 13), ON_LENS["holes"])
    for video in (depth, left, half, body, single):
        assert without_covered(NONE, seen_by(video))[1] == []


@pytest.mark.parametrize("how", ["dark", "a hand", "empty", "white walls"])
def test_a_covered_video_camera_is_named_where_nobody_is_detected(tmp_path, how):
    random = np.random.default_rng(0)
    scene = cv2.resize(random.integers(0, 255, (12, 16, 3), np.uint8), (160, 120))
    lens = {"dark": 0.02 * scene, "a hand": 110 + 0.1 * scene}.get(how, scene)
    if how == "white walls":  # a dark person before them is all the contrast there is
        scene, lens = np.full_like(scene, 230), np.full_like(scene, 230)
        scene[20:, 60:100] = 40
    gone, confidence = range(11, 20), np.full((30, 1, 33), 0.9)
    confidence[gone] = 0.0
    for k in range(30):
        image = (lens if k in gone else scene) + random.normal(0, 3, scene.shape)
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), np.clip(image, 0, 255).astype(np.uint8))
    points = Keypoints("b", "MEDIAPIPE_33", MEDIAPIPE_33, 10.0, np.full((30, 1, 33, 2), 50.0), confidence)
    take = SimpleNamespace(rate=10.0, cameras=(CameraEntry(name="b", video=tmp_path),), depth=())
    found = without_covered(take, seen_by(keypoints=(points,), paths={"b": tmp_path}))[1]
    assert [f.cameras for f in found] == ([("b",)] if how in ("dark", "a hand") else [])
    assert not found or "lens of b is probably covered from 1.10 to 1.90 s: its image is flat" in found[0].text


def stripes(depth, random, generator):
    """Light of another depth camera: in every other stripe a third of the pixels are holes, a seventh err."""
    light = (np.arange(60) // 6 + generator.integers(2))[:, None] % 2 == 0
    depth = np.where(light & (random < 0.36), 0.0, depth)
    return depth + (light & (random > 0.86) & (depth > 0)) * generator.normal(0.0, 0.15, depth.shape)


def rough(depth, random, generator):
    return depth + (depth > 0) * generator.normal(0.0, 0.03, depth.shape)


def test_a_depth_camera_with_light_of_its_kind_in_view_is_named_and_no_quiet_one(depth):
    take = SimpleNamespace(depth=tuple(DepthEntry(name=n, file=Path(n)) for n in ("depth", "other")))
    late = replace(depth.without(np.arange(15)), sensor="other")
    assert noise_findings(take, [depth, late]) == []
    (found,) = noise_findings(take, [changed(depth, range(15, 30), stripes), late])
    assert (found.severity, found.kind, found.cameras) == ("doubt", "noise", ("depth",))
    share = [int(s) for s in re.findall(r"(\d+) %", found.text)]
    assert share[0] > 20 and share[1] > 20 and share[2] < 5 and "while other runs" in found.text
    (found,) = noise_findings(take, [changed(depth, range(30), rough)])
    factor = float(re.search(r"depth is noisier than stated, by a factor of (\d\.\d)", found.text)[1])
    assert 1.7 < factor < 3.0  # 30 mm, of 10 mm or, 4 m away, of 22
    bare = changed(depth, range(30), lambda d, *_: np.where(d < 2.6, d, 0.0))
    assert noise_findings(take, [changed(bare, range(30), rough)]) == []  # nothing that rests
