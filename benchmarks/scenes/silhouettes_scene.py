"""What the benchmarks of silhouettes have in common: cameras, bodies of many triangles, movements, shapes of people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces.mesh import MeshSurface, triangles
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.parameters import Parameters
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.figures import look_at


def ring(count: int, *, size: tuple[int, int] = (640, 480), focal: float = 525.0, away: float = 3.0) -> Rig:
    """Cameras about a person who stands at the origin, y up."""
    cameras = []
    for k in range(count):
        turn = 2 * np.pi * k / count + 0.3
        eye = np.array([away * np.cos(turn), 1.1, away * np.sin(turn)])
        cameras.append(looking(f"cam{k}", eye, np.array([0.0, 0.9, 0.0]), size, focal))
    return Rig(tuple(cameras))


def looking(name: str, eye: NDArray, at: NDArray, size: tuple[int, int], focal: float) -> Camera:
    """A camera at a place that looks at another, y up."""
    K = [[focal, 0, size[0] / 2 - 0.5], [0, focal, size[1] / 2 - 0.5], [0, 0, 1]]
    return Camera(name, size, K, T_camera_world=look_at(eye, at, np.array([0.0, 1.0, 0.0])))


def shape_from_silhouettes(
    body: Body, rig: Rig, frames: Sequence[Sequence[SilhouetteFrame]], states: Sequence[BodyState],
    parameters: Sequence[Parameters], *, sigma: float = 4.0, settings: TrackSettings | None = None,
) -> SubjectFit:  # fmt: skip
    """Parameters and poses that explain silhouettes of several times; the overlap with them is printed.

    Parameters
    ----------
    frames : K lists of silhouettes, of the cameras that saw the body at one time.
    states : K poses near the truth.
    sigma : float [px] standard deviation of an outline.
    """
    settings = settings or TrackSettings()
    sensors = {camera.name: SilhouetteSensor(camera, sigma, settings) for camera in rig}

    def seen(body: Body, states: Sequence[BodyState]) -> tuple[list[list], float]:
        scene, steps, shares = Scene(body, states[0], rig), [], []
        for several, state in zip(frames, states, strict=True):
            here = scene.at(state)
            steps.append([sensors[frame.sensor].prepare(frame, here) for frame in several])
            shares += [measured.overlap(here) for measured in steps[-1]]
        return steps, float(np.mean(shares))

    steps, before = seen(body, states)
    found = fit_subject(body, rig, steps, states, parameters)
    _, after = seen(found.body, found.states)
    told = ", ".join(f"{n} {m:.2f} +- {s:.2f}" for n, m, s in zip(found.names, found.mean, found.std))
    print(f"# shape after {found.rounds} rounds: {told}")
    print(f"# overlap with the silhouettes it was found from {after:.3f}, {before:.3f} before")
    return found


def of_meshes(body: Body, around: int, along: int) -> Body:
    """The body with every cylinder as a mesh of so many corners and rings."""
    meshes = tuple(MeshSurface(s.segment, *triangles(s, around, along)) for s in body.surfaces)
    return replace(body, surfaces=meshes)


def standing(body: Body, angles: NDArray) -> BodyState:
    """The body with these angles, within its limits, on its feet."""
    T = np.eye(4)
    T[1, 3] = 0.95
    return BodyState(T, np.clip(angles, body.tree.lower, body.tree.upper))


def swaying(body: Body, frames: int, *, period: float = 60.0, seed: int = 0) -> list[BodyState]:
    """All joints swing to and fro about the usual posture, each by up to half a radian, once a period of frames."""
    spread = np.where(np.isfinite(body.tree.spread), body.tree.spread, 0.5)
    swing = 0.5 * np.random.default_rng(seed).normal(size=len(spread)) * np.minimum(spread, 0.5)
    usual = body.tree.usual
    return [standing(body, usual + swing * np.sin(2 * np.pi * i / period)) for i in range(frames)]
