"""Faults made in real recordings: what is wrong, and what a fault that names it says."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.robustness.faulty_recordings import Inputs
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.sensors.channels import mirror_name

LETTERBOXED = "letterboxed image called scaled"
GROUPS = "two of four cameras show another motion"
DISTORTED = ("landmarks", "seated")  # with lenses that bend visibly


@dataclass(frozen=True)
class Fault:
    """A wrong input: how it is made, what a fault that names it says, and which camera it is about, from 0."""

    make: Callable[[Inputs], Inputs]
    says: str
    camera: int | None = None


def _cameras(change: Callable[[Camera], Camera], only: int | None = None) -> Callable[[Inputs], Inputs]:
    def make(inputs: Inputs) -> Inputs:
        cameras = (change(c) if only in (None, k) else c for k, c in enumerate(inputs.rig))
        return replace(inputs, rig=Rig(tuple(cameras)))

    return make


def _points(change: Callable[[Camera, NDArray], NDArray], only: int | None = None) -> Callable[[Inputs], Inputs]:
    def make(inputs: Inputs) -> Inputs:
        every = enumerate(zip(inputs.rig, inputs.points, strict=True))
        return replace(inputs, points=tuple(change(c, uv) if only in (None, k) else uv for k, (c, uv) in every))

    return make


def _translated(factors: float | NDArray) -> Callable[[Camera], Camera]:
    return lambda c: c.with_pose(se3.transform(c.T_camera_world[:3, :3], factors * c.T_camera_world[:3, 3]))


def _turned(degrees: float) -> Callable[[Camera], Camera]:
    turn = se3.transform(se3.exp_so3(np.radians([0.0, degrees, 0.0])), np.zeros(3))
    return lambda c: c.with_pose(turn @ c.T_camera_world)


def _zoomed(camera: Camera) -> Camera:
    return replace(camera, matrix=camera.matrix * np.array([[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]]))


def _exchanged(names: tuple[str, ...], uv: NDArray) -> NDArray:
    return uv[:, [names.index(mirror_name(n) or n) for n in names]]


def _mirrored(camera: Camera, uv: NDArray) -> NDArray:
    return np.concatenate([camera.size[0] - 1 - uv[..., :1], uv[..., 1:]], axis=-1)


def _swapped(inputs: Inputs) -> Inputs:
    a, b, *rest = inputs.points
    return replace(inputs, points=(b, a, *rest))


def _late(camera: int, frames: int) -> Callable[[Inputs], Inputs]:
    def make(inputs: Inputs) -> Inputs:
        cut = (uv[frames:] if k == camera else uv[: len(uv) - frames] for k, uv in enumerate(inputs.points))
        return replace(inputs, points=tuple(cut))

    return make


def _parted(inputs: Inputs) -> Inputs:
    """The last two cameras show the first half again, backwards."""
    half = len(inputs.points[0]) // 2
    backwards = [np.concatenate([uv[:half], uv[: len(uv) - half][::-1]]) for uv in inputs.points[2:]]
    return replace(inputs, points=(*inputs.points[:2], *backwards))


def faults(inputs: Inputs) -> Iterator[tuple[str, Fault]]:
    """What is made wrong with a recording."""
    sides = _points(lambda _, uv: _exchanged(inputs.names, uv))
    image = _points(lambda c, uv: _exchanged(inputs.names, _mirrored(c, uv)))
    one_image = _points(lambda c, uv: _exchanged(inputs.names, _mirrored(c, uv)), 3)
    yield "translations times 1.8", Fault(_cameras(_translated(1.8)), r"would be [\d.]+ m tall")
    yield "metres called millimetres", Fault(lambda i: replace(i, unit="mm"), r'unit = "m", not "mm"')
    yield "wrong vertical axis", Fault(lambda i: replace(i, up=i.wrong_up), r"up = .* is wrong")
    yield "left and right exchanged", Fault(sides, r"Left and right are swapped")
    yield "all images mirrored", Fault(image, r"All images are mirrored left to right")
    yield "one image mirrored", Fault(one_image, r"image is mirrored left to right", 3)
    yield "fx and fy of all halved", Fault(_cameras(_zoomed), r"focal lengths of all cameras are about half")
    yield "fx and fy of one halved", Fault(_cameras(_zoomed, 1), r"focal length is about half", 1)
    yield GROUPS, Fault(_parted, r"show another motion than")
    x = np.array([-1.0, 1.0, 1.0])
    yield "the x of a translation negated", Fault(
        _cameras(_translated(x), inputs.shifted), r"the x of the translation has the wrong sign", inputs.shifted
    )
    yield "a camera turned", Fault(_cameras(_turned(inputs.turn), 2), r"has moved or rotated|disagrees with", 2)
    yield "a camera out of step", Fault(_late(0, inputs.late), r"frames \(\d+ ms\) later", 0)
    yield "names of two cameras exchanged", Fault(_swapped, r"are swapped\.")
    if inputs.name in DISTORTED:
        ideal = _cameras(lambda c: replace(c, distortion=np.zeros(4)))
        yield "lens distortion left out", Fault(ideal, r"no lens distortion")
    if inputs.boxed:
        yield LETTERBOXED, Fault(lambda i: replace(i, image="scaled"), r"cam01 is scaled by the take, but")
