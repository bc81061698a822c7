"""Unknowns of gear as parameters of a subject fit: dimensions, and places in the world (P3 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.closures import Closure, Dimension
from kinefit.bodies.parts import known_gear, with_dimensions, with_places
from kinefit.fitting.subject.parameters import Parameters, World
from kinefit.geometry import se3
from kinefit.sensors.base import Matched
from kinefit.sensors.channels import ChannelResiduals
from kinefit.solving.equations import residuals
from kinefit.solving.rows import AnyRows
from kinefit.solving.trajectory.variance_components import variance_components

_WHERE = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class Gear(Parameters):
    """Dimensions of a body's gear and places of closures in the world, of those that the body file marks as unknown.

    A place is a translation [m] and, for a rigid closure, a rotation vector [rad], both from the world's origin.
    Outside a subject fit, closures with an unknown place are as soft as the place is uncertain. In the fit they have
    their own standard deviation.

    Parameters
    ----------
    body : Body, as its file has it
    """

    body: Body
    of_points = True

    @cached_property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions to estimate."""
        return tuple(d for d in self.body.dimensions if d.std > 0.0)

    @cached_property
    def places(self) -> tuple[Closure, ...]:
        """Closures whose place in the world is to be estimated."""
        return tuple(c for c in self.body.closures if c.place_std > 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) names of dimensions, then of each place's axes."""
        out = [f"gear {d.name}" for d in self.dimensions]
        return (*out, *(f"{c.name} {axis}" for c in self.places for axis in _WHERE[: _count(c)]))

    @property
    def mean(self) -> NDArray:
        """(p,) [m, rad] prior mean."""
        values = [d.value for d in self.dimensions]
        return np.array(values + [v for c in self.places for v in (*c.place, *c.turn)[: _count(c)]])

    @property
    def information(self) -> NDArray:
        """(p, p) [1/m², 1/rad²] prior information."""
        std = [d.std for d in self.dimensions]
        std += [s for c in self.places for s in (*[c.place_std] * 3, *[c.turn_std] * 3)[: _count(c)]]
        return np.diag(np.array(std) ** -2.0)

    def apply(self, world: World, values: NDArray) -> World:
        """The world with gear of these values (p,) [m, rad], which count as known."""
        count = len(self.dimensions)
        wanted = dict(zip((d.name for d in self.dimensions), np.asarray(values, float)[:count].tolist()))
        body, rest = with_dimensions(world.body, wanted), np.asarray(values, float)[count:]
        places = {}
        for c in self.places:
            own, rest = rest[: _count(c)], rest[_count(c) :]
            places[c.name] = own[:3], own[3:] if c.kind == "rigid" else np.array(c.turn)
        return replace(world, body=known_gear(with_places(body, places)))

    def start(self, states: Sequence[BodyState]) -> NDArray:
        """(p,) [m, rad] values to start from: prior means of dimensions, and medians of places over tracked poses."""
        out, at = self.mean, len(self.dimensions)
        if not len(states):
            return out
        for c in self.places:
            point = self.body.landmarks.select((c.point,))
            segment = int(point.segments[0])
            x = np.array([self.body.positions(s, point)[0] for s in states])
            out[at : at + 3] = np.median(x, axis=0)
            if c.kind == "rigid":
                R = [
                    self.body.tree.segment_poses(s.T_world_root[None], s.angles[None])[0, segment, :3, :3]
                    for s in states
                ]
                out[at + 3 : at + 6] = se3.log_so3(_middle(np.array(R)))
            at += _count(c)
        return out


def _count(c: Closure) -> int:
    return 6 if c.kind == "rigid" else 3


def _middle(R: NDArray) -> NDArray:
    """(3, 3) median of rotations (K, 3, 3): the one with the smallest sum of angles to all others."""
    angle = np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1.0) / 2.0, -1.0, 1.0))
    return np.asarray(R[int(np.argmin(angle.sum(axis=1)))])


_MIN_RESIDUALS = 10  # of a sensor: with fewer its excess is not estimated
_MAX_ABSORBED = 0.75  # share of all biases that parameters of the fit may absorb
_MIN_EXCESS = 1e-3  # reported for a sensor whose residuals are almost zero


FrameRows = tuple[Matched, Sequence[AnyRows]]
"""A match, with sensor and channels, and its rows at the fit."""


def excess(frames: Sequence[Sequence[FrameRows]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of all frames together exceeds that of their rows.

    The variance of a channel with n rows is that of its jitter plus n times that of its bias. The factor is below 1
    where residuals are smaller than the rows' standard deviations. Channels of points are points along each axis, with
    biases of one size. Channels of surfaces are whole segments, because surface errors are constant over a patch; each
    has a bias of its own size, since segments differ in the number of rows and in their bias.

    Parameters
    ----------
    frames : rows of every measurement of each frame
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data determine
    """
    collected, of_points = ChannelResiduals(), dict[str, bool]()
    for f, measured in enumerate(frames):
        for m, rows in measured:
            used = [r.weight > 0.0 if r.weight.ndim == 1 else np.ones(len(r), bool) for r in rows]
            collected.add(f, m, rows, [residuals(r) for r in rows], [w.astype(float) for w in used])
            of_points[m.sensor] = m.of_points
    found = {s: both for s, both in collected.arrays(len(frames)).items() if both[1].sum() >= _MIN_RESIDUALS}
    looks = {
        s: float(count.any(axis=0).sum() if of_points[s] else count.sum() / len(frames))
        for s, (_, count) in found.items()
    }
    absorbed, out = min(followed / max(sum(looks.values()), 1.0), _MAX_ABSORBED), {}
    for s, (values, count) in found.items():
        C = values.shape[1]
        errors = variance_components(values, leverage=np.full(C, absorbed * of_points[s]), group=np.arange(C))
        jitter, bias = (float(np.median(v)) ** 2 for v in (errors.jitter, errors.bias))
        rows = count.sum(axis=0)
        white, constant = jitter * (count**2).sum(), bias * (rows**2).sum()
        if not of_points[s]:
            sums = np.nansum(np.where(errors.outlier[..., None], np.nan, values * count), axis=0)
            constant = max((sums**2).sum() - white, 0.0)
        out[s] = max(float(white + constant) / float(rows.sum()), _MIN_EXCESS)
    return out
