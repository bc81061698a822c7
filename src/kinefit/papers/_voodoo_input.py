"""The five inputs of VooDoo (P2 4.1) from sensor frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry import lines
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.depth import to_points
from kinefit.observations import DepthFrame, Frame, KeypointFrame, MarkerFrame, PointCloud, by_record
from kinefit.papers._voodoo_boxes import Boxes, in_body_box
from kinefit.sensors.channels import joined

_MAX_COLUMNS = 160  # of a depth image, approximately: those of P2's time-of-flight camera


@dataclass(frozen=True, eq=False)
class Sight:
    """Observations at one time, sorted by what they are assigned to; lengths [m] in the world, a weight for each.

    Parameters
    ----------
    free : (N, 3) points on any surface
    on_body : (N, 3) points on the body, on any of its limbs
    on_limb : (N, 3) points on the limb `limb` (N,)
    points, places : points of the body, and their measured positions (K, 3)
    features, lines : points of the body, and their Plücker lines (K, 6) of sight
    """

    free: NDArray
    free_weight: NDArray
    on_body: NDArray
    on_body_weight: NDArray
    on_limb: NDArray
    on_limb_weight: NDArray
    limb: NDArray
    points: PointSet
    places: NDArray
    places_weight: NDArray
    features: PointSet
    lines: NDArray
    lines_weight: NDArray


def near_body(
    sight: Sight, boxes: Boxes, frames: NDArray, reach: float, floor: tuple[float, float, float, float] | None,
    clear: float,
) -> Sight:  # fmt: skip
    """Drop free points outside of the body's box enlarged by `reach` [m], or less than `clear` [m] above the floor.

    frames (S, 12); floor: plane a, b, c, d with a x + b y + c z = d [m].
    """
    near = in_body_box(sight.free, boxes, frames, reach)
    if floor is not None:
        near &= sight.free @ np.array(floor[:3]) > floor[3] + clear
    return replace(sight, free=sight.free[near], free_weight=sight.free_weight[near])


def sight_of(frames: Sequence[Frame], body: Body, rig: Rig, weights: Mapping[str, float]) -> Sight:
    """Sort the frames of one time, and weight them: by a feature's name, else its sensor's, else 1 (unitless).

    Raises
    ------
    ObservationError
        A weight that is negative or not finite; a camera that is not in the rig (as `Rig`).
    """
    for name, weight in weights.items():
        if not 0.0 <= weight < np.inf:
            raise ObservationError(f"the weight of {name} is {weight}", remedy="Give 0 or more.")
    by_type, of = by_record(frames), {f.sensor: weights.get(f.sensor, 1.0) for f in frames}
    clouds: list[list] = [[], [], []]  # free, on the body, on a limb: (points, weight, limb)
    for f in by_type[DepthFrame]:
        step = max(f.size[0] // _MAX_COLUMNS, 1)
        clouds[0].append((to_points(f.depth, rig[f.sensor], step=step), of[f.sensor], -1))
    for f in by_type[PointCloud]:
        limb = -1 if f.segment is None else body.tree.segment(f.segment)
        clouds[2 if limb >= 0 else int(f.on_body)].append((f.points, of[f.sensor], limb))
    sets = [body.markers(f.marker_set) if f.marker_set else body.landmarks for f in by_type[MarkerFrame]]
    places = [_named(k, f.names, f.positions, weights, of[f.sensor]) for k, f in zip(sets, by_type[MarkerFrame])]
    sets = [body.keypoints(f.keypoint_set) if f.keypoint_set else body.landmarks for f in by_type[KeypointFrame]]
    rays = [
        _named(k, f.names, _rays(f, rig[f.sensor]), weights, of[f.sensor]) for k, f in zip(sets, by_type[KeypointFrame])
    ]
    x = [np.concatenate([p for p, _, _ in part] or [np.zeros((0, 3))]) for part in clouds]
    w = [np.concatenate([np.full(len(p), a) for p, a, _ in part] or [np.zeros(0)]) for part in clouds]
    limbs = np.concatenate([np.full(len(p), k) for p, _, k in clouds[2]] or [np.zeros(0, np.int64)])
    return Sight(x[0], w[0], x[1], w[1], x[2], w[2], limbs, *_all(places, 3), *_all(rays, 6))


def _rays(frame: KeypointFrame, camera: Camera) -> NDArray:
    """Plücker lines (K, 6) in the world, NaN for keypoints without detection."""
    directions, out = camera.ray(frame.uv), np.full((len(frame.names), 6), np.nan)
    by_type = np.isfinite(directions).all(axis=1) & (frame.confidence > 0.0)
    if by_type.any():
        out[by_type] = lines.line_along(camera.centre_world, directions[by_type])
    return out


def _named(
    known: PointSet, names: Sequence[str], values: NDArray, weights: Mapping[str, float], weight: float
) -> tuple[PointSet, NDArray, NDArray]:
    rows = [k for k, name in enumerate(names) if name in known.names]
    chosen = tuple(names[k] for k in rows)
    return known.select(chosen), values[rows], np.array([weights.get(name, weight) for name in chosen])


def _all(parts: list, columns: int) -> tuple[PointSet, NDArray, NDArray]:
    if not parts:
        return PointSet((), np.zeros(0, np.int64), np.zeros((0, 3))), np.zeros((0, columns)), np.zeros(0)
    sets, values, weights = zip(*parts)
    return joined(sets), np.concatenate(values), np.concatenate(weights)
