"""Errors of a motion against the true one: joint centres, angles, orientations, coverage of error bars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.tree import twin
from kinefit.errors import ObservationError
from kinefit.motion import Motion


def joint_errors(truth: Motion, result: Motion) -> NDArray:
    """Distances (F, S) [m] between the joint centres of two motions; their bodies may have different lengths.

    Raises
    ------
    ObservationError
        The motions differ in frames or in their bodies' segments. All functions here raise it.
    """
    result = _comparable(truth, result)
    return np.linalg.norm(result.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3], axis=-1)


def angle_errors(truth: Motion, result: Motion) -> NDArray:
    """Differences (F, D) [deg] of all angles, result minus truth, between -180 and 180; of prismatic joints [m].

    A ball joint with three orthogonal axes has two triples (a, b, c) and (a + 180, 180 - b, c + 180) for every
    rotation; the one nearer to the truth is used. Near gimbal lock, large angle errors may belong to nearly equal
    rotations: see `orientation_errors`.
    """
    result = _comparable(truth, result)
    tree = truth.body.tree
    errors = _wrapped(result.angles - truth.angles)
    for d in tree.ball_joints:
        other = _wrapped(twin(result.angles[:, d]) - truth.angles[:, d])
        nearer = np.abs(other).sum(axis=1) < np.abs(errors[:, d]).sum(axis=1)
        errors[nearer, d] = other[nearer]
    return np.where(tree.prismatic, result.angles - truth.angles, errors)


def _wrapped(radians: NDArray) -> NDArray:
    """Angles wrapped to -180..180 [deg]."""
    return np.degrees(np.angle(np.exp(1j * radians)))


def orientation_errors(truth: Motion, result: Motion, *, relative: bool = False) -> NDArray:
    """Angles (F, S) [deg] between the orientations of every segment: in the world, or relative to its parent."""
    result = _comparable(truth, result)
    a, b = (m.segment_poses()[..., :3, :3] for m in (truth, result))
    if relative:
        parents, child = truth.body.tree.parents, truth.body.tree.parents >= 0
        for R in (a, b):
            R[:, child] = R[:, parents[child]].swapaxes(-1, -2) @ R[:, child]
    # |A - B| (Frobenius) = 2 √2 sin(θ/2), exact for small angles too
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8.0), 0.0, 1.0)))


@dataclass(frozen=True)
class ErrorBarCoverage:
    """Share 0..1 of the true values within the error bars; NaN without finite error bars.

    Parameters
    ----------
    joints : of the coordinates of all joint centres.
    angles : of all angles.
    """

    joints: float
    angles: float


def coverage(truth: Motion, result: Motion, *, sigmas: float = 2.0) -> ErrorBarCoverage:
    """Share of joint centres and angles whose truth lies within `sigmas` standard deviations; 0.954 is ideal for 2."""
    (shift, joints), (angles, dofs) = _errors_and_bars(truth, result, sigmas)
    return ErrorBarCoverage(_share(shift, joints), _share(angles, dofs))


def coverage_of_groups(truth: Motion, result: Motion, *, sigmas: float = 1.96) -> dict[str, ErrorBarCoverage]:
    """Coverage (see `coverage`) for each group of joints: the body's scale groups, with both sides together.

    A joint belongs to the group of the segment that it moves. sigmas: a number of standard deviations.
    """
    (shift, joints), (angles, dofs) = _errors_and_bars(truth, result, sigmas)
    out = {}
    for g, name in enumerate(truth.body.scale_groups):
        segments = truth.body.segment_scale == g
        own = segments[truth.body.tree.owners]
        covered = _share(shift[:, segments], joints[:, segments]), _share(angles[:, own], dofs[:, own])
        out[name] = ErrorBarCoverage(*covered)
    return out


def _errors_and_bars(truth: Motion, result: Motion, sigmas: float) -> tuple[tuple[NDArray, NDArray], ...]:
    """Errors of joint centres (F, S, 3) [m] and of angles (F, D) [rad, m], each with its error bars."""
    turned = _comparable(truth, result)
    shift = np.abs(turned.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3])
    angles = angle_errors(truth, result)
    angles = np.abs(np.where(truth.body.tree.prismatic, angles, np.radians(angles)))
    return (shift, sigmas * turned.joint_std), (angles, sigmas * turned.dof_std[:, 6:])


def _share(errors: NDArray, bars: NDArray) -> float:
    known = np.isfinite(bars)
    return float(np.mean(errors[known] <= bars[known])) if known.any() else float("nan")


def _comparable(truth: Motion, result: Motion) -> Motion:
    """The result with the vertical axis of the truth; raises ObservationError for motions that do not match."""
    a, b = truth.body.tree, result.body.tree
    if a.segments != b.segments or a.coordinates != b.coordinates:
        raise ObservationError(
            f"the bodies '{truth.body.name}' and '{result.body.name}' have different segments",
            remedy="Compare motions of bodies with the same segments.",
        )
    if len(truth) != len(result) or not np.isclose(truth.rate, result.rate):
        raise ObservationError(
            f"the truth has {len(truth)} frames at {truth.rate:g} Hz, the result {len(result)} at {result.rate:g} Hz",
            remedy="Cut and resample one of them (kinefit.simulation).",
        )
    return result if result.up == truth.up else result.turned(truth.up)
