"""Frames a second by sensor and by number of cameras, from what a sensor gives to a judged pose.

A person (the catalogue's humanoid) sways in the middle of a ring of cameras. Keypoints: MediaPipe's 33 points with 3 px
of noise. Masks and colour pictures: 640 x 480. Depth: 320 x 240 images of the person before a wall that the sensor saw
empty. Markers: 45 with 1 mm of noise. Processor time of all threads; of each frame the least of some rounds, of those
the median. One body of cylinders and ellipsoids, default settings; the first frames, and detectors, are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.figures import amount, figure
from benchmarks.scenes.silhouettes_scene import ring, swaying
from benchmarks.speed.regions_speed import pictures
from benchmarks.speed.rounds import Rounds, tracked_rounds
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame, DepthFrame, KeypointFrame, MarkerFrame, SilhouetteFrame

FRAMES, WARM, ROUNDS, RATE = amount(40, 6), amount(5, 2), amount(4, 1), 30.0
CAMERAS = amount((1, 2, 4, 8), (1, 2))
WALL = 4.5  # [m] from each camera
_HOW = {"rate": RATE, "rounds": ROUNDS, "warm": WARM}
GOALS = {"keypoints": ">= 100", "masks": ">= 30", "colours": ">= 30", "depth": ">= 30", "markers": ">= 300"}
"""Frames a second with four cameras; of markers with their system."""

Frames = list[list[Any]]


def run() -> None:
    """Print the table."""
    body = load_body("humanoid")
    truth = swaying(body, FRAMES)
    rig, coarse = ring(CAMERAS[-1]), ring(CAMERAS[-1], size=(320, 240), focal=262.5)
    rows = {"keypoints": keypoints(body, truth, rig), "masks": masks(body, truth, rig)}
    rows |= {"colours": colours(body, truth, rig), "depth": depth(body, truth, coarse)}
    for name, frames in rows.items():
        own, each = coarse if name == "depth" else rig, {}
        empty = [np.full(camera.size[::-1], WALL) for camera in own] if name == "depth" else []
        for count in CAMERAS:
            seen = [[f for f in step if f.sensor in own.names[:count]] for step in frames]
            each[count] = tracked_rounds(body, Rig(own.cameras[:count]), truth, seen, empty=empty[:count], **_HOW)
        table(name, each, "cameras")
    with_markers = {1: tracked_rounds(body, rig, truth, markers(body, truth), **_HOW)}
    table("markers", with_markers, "system")


def table(name: str, each: dict[int, Rounds], of: str) -> None:
    """One row: frames a second, and what a camera more costs."""
    told = ", ".join(f"{count} {of} {1e3 / ms:.0f} frames/s ({ms:.2f} ms)" for count, (ms, *_) in each.items())
    print(f"# {name}: {told}; at most {max(one.degrees for one in each.values()):.1f} degrees off a joint, on average")
    four = each.get(4, each[max(each)])
    figure(f"speed_{name}", 1e3 / four.ms, "frames/s", GOALS[name])


def by_cameras(truth: Sequence[BodyState], rig: Rig, frame: Callable[[Camera, BodyState, float], Any]) -> Frames:
    """What every camera gives of every state."""
    return [[frame(camera, state, i / RATE) for camera in rig] for i, state in enumerate(truth)]


def keypoints(body: Body, truth: Sequence[BodyState], rig: Rig) -> Frames:
    """Detected points, all of them sure."""
    points, random = body.keypoints("MEDIAPIPE_33"), np.random.default_rng(1)

    def frame(camera: Camera, state: BodyState, at: float) -> KeypointFrame:
        uv = camera.project(body.positions(state, points)) + random.normal(0.0, 3.0, (len(points), 2))
        return KeypointFrame(camera.name, at, points.names, uv, np.ones(len(points)), "MEDIAPIPE_33")

    return by_cameras(truth, rig, frame)


def masks(body: Body, truth: Sequence[BodyState], rig: Rig) -> Frames:
    """Where the person is."""
    mesh = body_mesh(body)
    return by_cameras(
        truth, rig, lambda c, s, at: SilhouetteFrame(c.name, at, render_body(body, s, c, mesh=mesh).seen)
    )


def colours(body: Body, truth: Sequence[BodyState], rig: Rig) -> Frames:
    """Pictures of a painted person before a wall of many colours."""
    seen = pictures(body, rig, truth)
    return [[ColourFrame(name, i / RATE, image) for name, image in one.items()] for i, one in enumerate(seen)]


def depth(body: Body, truth: Sequence[BodyState], rig: Rig) -> Frames:
    """Depth images of a person before a wall."""
    mesh, random = body_mesh(body), np.random.default_rng(2)

    def frame(camera: Camera, state: BodyState, at: float) -> DepthFrame:
        drawn = render_body(body, state, camera, mesh=mesh)
        image = np.where(drawn.seen, drawn.depth, WALL)
        return DepthFrame(camera.name, at, image + random.normal(0.0, 0.004, image.shape))

    return by_cameras(truth, rig, frame)


def markers(body: Body, truth: Sequence[BodyState]) -> Frames:
    """All markers of one system."""
    points, random = body.markers("HANIM_45"), np.random.default_rng(3)
    return [
        [MarkerFrame("markers", i / RATE, points.names,
                     body.positions(state, points) + random.normal(0.0, 0.001, (len(points), 3)), "HANIM_45")]
        for i, state in enumerate(truth)
    ]  # fmt: skip
