"""Depth images: how fast they become points, and whether the people in real ones are counted right."""

from __future__ import annotations

import time

from benchmarks.figures import each, figure, recording
from benchmarks.timing import fastest

_PEOPLE = 14  # in the twelve images of depth_skeltrack_kinect1: ten of one person, two of two


def run() -> None:
    """Print the figures."""
    each(_speed, _count)


def _speed() -> None:
    from kinefit import Camera
    from kinefit.images.depth import clean, downsample, to_points
    from kinefit.readers import read_depth

    goal, folder = "<= 0.5", recording("depth_sr305_upperbody")
    video = read_depth(folder / "20210326-231615", unit=0.000125)
    camera = Camera("sr305", video.size, [[476.007, 0, 313.683], [0, 476.007, 242.755], [0, 0, 1]])
    depth = video.frame(0).depth
    made = lambda: downsample(to_points(clean(depth, camera, near=0.2, far=1.5), camera, step=3), maximum=5000)
    points, best = fastest(made, 200, clock=time.perf_counter)
    figure("depth_image_to_points_ms", 1e3 * best, f"ms, 640x480 cleaned, {len(points)} points, best of 200", goal)


def _count() -> None:
    from kinefit import Camera
    from kinefit.images.depth import clean
    from kinefit.images.depth_scene import people
    from kinefit.readers import read_depth

    goal, folder = "== 12", recording("depth_skeltrack_kinect1")
    camera = Camera("kinect", (640, 480), [[575, 0, 319.5], [0, 575, 239.5], [0, 0, 1]])
    video = read_depth(folder, size=(640, 480))
    found = [len(people(clean(video.frame(i).depth, camera), camera)) for i in range(len(video))]
    right = sum(n in (1, 2) for n in found) if sum(found) == _PEOPLE and found.count(2) == 2 else 0
    figure("depth_images_people_counted", right, "images of 12", goal)
