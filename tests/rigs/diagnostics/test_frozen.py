"""Streams that repeat one frame are named and lose these frames; people, robots and empty images at rest are not."""

from dataclasses import dataclass

import numpy as np
import pytest

from kinefit.observations import DepthVideo, Keypoints, Markers
from kinefit.observations.videos import LineVideo
from kinefit.readers.take.load import Observations
from kinefit.rigs.diagnostics.images import without_frozen

COUNT, FROZEN = 90, range(40, 65)
RANDOM = np.random.default_rng(5)
PATH = 300.0 + 80.0 * np.sin(np.arange(COUNT) / 12.0)[:, None, None] + 20.0 * np.arange(6)[:, None] * np.ones(2)


@dataclass(frozen=True)
class Sensor:
    """What `Observations.sensors` holds of a sensor, as far as it is asked for."""

    recording: LineVideo


def stopped(values, frames=FROZEN):
    out = values.copy()
    out[frames.start :][: len(frames)] = values[frames.start - 1]
    return out


def keypoints(points, camera="a"):
    names = tuple(f"p{k}" for k in range(points.shape[1]))
    return Keypoints(camera, "own", names, 30.0, points[:, None], np.full((COUNT, 1, len(names)), 0.9))


def markers(x):
    return Markers(tuple(f"m{k}" for k in range(x.shape[1])), 100.0, x)


def depth(images):
    return DepthVideo("d", 30.0, np.arange(COUNT) / 30.0, images.shape[2:0:-1], lambda i: images[i], near=0.1, far=9.0)


def seen(keypoints=(), markers=(), depth=(), sensors=()):
    return Observations(30.0, (100, 100 + COUNT), None, keypoints, markers, {}, {}, depth=depth, sensors=sensors)


NOISY = PATH + RANDOM.normal(0, 1.0, PATH.shape)
IMAGES = 2.0 + RANDOM.normal(0, 0.01, (COUNT, 24, 32))


def test_a_frozen_camera_is_named_with_its_frames_which_are_left_out():
    right = keypoints(NOISY, "b")
    out, (found,) = without_frozen(seen((right, keypoints(stopped(NOISY)))))
    assert (found.severity, found.kind, found.cameras) == ("doubt", "frozen", ("a",))
    assert "a is frozen in frames 140 to 164 (1.33 to 2.13 s)" in found.text
    assert out.keypoints[0] is right
    assert [f for f in range(COUNT) if np.isnan(out.keypoints[1].points[f]).all()] == list(FROZEN)
    assert not out.keypoints[1].confidence[FROZEN].any()


def test_frozen_markers_depth_images_and_other_sensors_are_alike():
    x = np.concatenate([NOISY, NOISY[..., :1]], axis=-1) / 1000.0
    ends = stopped(np.stack([NOISY, NOISY + 9], axis=2))
    frozen = LineVideo("e", 30.0, np.arange(COUNT) / 30.0, tuple("abcdef"), (("x",),) * 6, ends)
    every = seen(markers=(markers(stopped(x)),), depth=(depth(stopped(IMAGES)),), sensors=(Sensor(frozen),))
    out, found = without_frozen(every)
    assert [f.cameras for f in found] == [("markers",), ("d",), ("e",)]
    assert np.isnan(out.markers[0].positions[FROZEN]).all() and np.isfinite(out.markers[0].positions[39]).all()
    assert [k for k in range(COUNT) if out.depth[0].at_step(k, 30.0) is None] == list(FROZEN)
    ends = out.sensors[0].recording.ends
    assert np.isnan(ends[FROZEN]).all() and np.isfinite(ends[65]).all()


@pytest.mark.parametrize("what", ["noise", "short", "few points", "pixels", "rests smoothly", "slow video", "whole"])
def test_what_is_not_frozen_is_no_news(what):
    rest = np.where(np.isin(np.arange(COUNT), FROZEN)[:, None, None], PATH[40], PATH)
    eased = 300.0 + 80.0 * np.cumsum(np.clip(np.abs(np.arange(COUNT) - 50.0) - 12, 0, None) ** 2)[:, None, None] / 9e3
    points = {
        "noise": rest + RANDOM.normal(0, 1.0, PATH.shape), "short": stopped(NOISY, range(40, 44)),
        "few points": np.concatenate([stopped(NOISY)[:, :3], NOISY[:, 3:]], axis=1),
        "pixels": np.round(rest + RANDOM.normal(0, 0.2, PATH.shape)), "rests smoothly": eased + PATH[:1],
        "slow video": NOISY[3 * (np.arange(COUNT) // 3)], "whole": np.tile(NOISY[:1], (COUNT, 1, 1)),
    }[what]  # fmt: skip
    assert without_frozen(seen((keypoints(points),)))[1] == []


def test_depth_images_of_an_empty_range_are_not_frozen():
    gone = IMAGES.copy()
    gone[FROZEN] = 0.0
    still = np.tile(IMAGES[:1], (COUNT, 1, 1))  # a still image of a program
    assert without_frozen(seen(depth=(depth(gone), depth(still))))[1] == []
