"""Change a body: add and remove parts, replace surfaces, other dimensions and places of gear, convert its state.

New parts are appended, so that indices of segments and coordinates do not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._files import repeated
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.surfaces import MeshSurface, Surface
from kinefit.bodies.tree import COLUMNS, BodyState, Closure, KinematicTree, without_landmarks
from kinefit.errors import BodyError, check_choice
from kinefit.geometry import se3

# Corners of a box by the bits of their index (x: 1, y: 2, z: 4), two triangles a side, counter-clockwise from outside.
_SIDES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))


@dataclass(frozen=True)
class PartJoint:
    """Joint between a part and its parent; without coordinates the part is fixed.

    Parameters
    ----------
    at : (3,) [m] joint centre in the parent's frame.
    coordinates : (k,) names
    axes : (k, 3) directions in the root-aligned rest frame
    slides : (k,) bool, whether it slides along its axis instead of rotating about it; default none.
    lower, upper : (k,) [rad] or [m], default no limits.
    usual, spread : (k,) [rad] or [m], mean and standard deviation of the prior; default 0 and no prior.
    """

    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    coordinates: tuple[str, ...] = ()
    axes: tuple[tuple[float, float, float], ...] = ()
    slides: tuple[bool, ...] = ()
    lower: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()
    usual: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()


def with_part(
    body: Body,
    name: str,
    *,
    parent: str,
    surfaces: Surface | Sequence[Surface],
    joint: PartJoint | None = None,
    landmarks: dict[str, tuple[float, float, float]] | None = None,
) -> Body:
    """Add a segment to a body: a carried box, a ski, a tool.

    Parameters
    ----------
    body : Body
    name : of the new segment.
    parent : name of the segment that holds it.
    surfaces : one or several; their `segment` is set to the new one.
    joint : PartJoint, default fixed at the parent's joint.
    landmarks : name -> (3,) [m] in the part's frame, which is aligned with the root's at rest.

    Raises
    ------
    BodyError
        A name that exists, an unknown parent, a joint with inconsistent or invalid numbers.
    """
    joint, tree = joint or PartJoint(), body.tree
    for what, new, old in (
        ("segment", (name,), tree.segments),
        ("coordinate", joint.coordinates, tree.coordinates),
        ("landmark", tuple(landmarks or ()), body.landmarks.names),
    ):
        taken = sorted(set(new) & set(old)) + sorted(repeated(new))
        if taken:
            raise BodyError(f"{what} '{taken[0]}' exists already", place=f"part {name}", remedy="Choose another.")
    here = len(tree.segments)
    own = [surfaces] if isinstance(surfaces, Surface) else list(surfaces)
    points = np.array(list((landmarks or {}).values()), float).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise BodyError("a landmark is not finite", place=f"part {name}", remedy="Give three numbers in metres.")
    return replace(
        body,
        tree=_with_segment(tree, name, tree.segment(parent), joint),
        joints=(*body.joints, f"{name}_joint"),
        scale_groups=(*body.scale_groups, _free_name(name, body.scale_groups)),
        segment_scale=np.append(body.segment_scale, len(body.scale_groups)),
        surfaces=(*body.surfaces, *(replace(s, segment=here) for s in own)),
        landmarks=PointSet(
            (*body.landmarks.names, *(landmarks or ())),
            np.append(body.landmarks.segments, np.full(len(points), here)),
            np.concatenate([body.landmarks.points, points]),
        ),
    )


def without_part(body: Body, name: str) -> Body:
    """Remove a segment with its surfaces, landmarks, keypoints, markers and coordinates.

    Raises
    ------
    BodyError
        An unknown name, the root, a segment with children, or a body with a skin.
    """
    tree = body.tree
    if body.skin is not None:
        raise BodyError("a body with a skin keeps its parts", place=f"part {name}", remedy="Remove the skin first.")
    removed = tree.segment(name)
    if removed == 0:
        raise BodyError(f"'{name}' is the root", place=f"part {name}", remedy="A body needs its root.")
    children = [s for s, p in zip(tree.segments, tree.parents) if p == removed]
    if children:
        remedy = "Remove those first, beginning at the end of the chain."
        raise BodyError(f"it has the children {', '.join(children)}", place=f"part {name}", remedy=remedy)
    kept = np.arange(len(tree.segments)) != removed
    used = sorted(set(body.segment_scale[kept].tolist()))
    left = body.with_points(lambda points: _remaining_points(points, removed))
    return replace(
        left,
        tree=_without_segment(tree, removed),
        joints=tuple(j for j, keep in zip(body.joints, kept) if keep),
        scale_groups=tuple(body.scale_groups[g] for g in used),
        segment_scale=np.searchsorted(used, body.segment_scale[kept]),
        surfaces=tuple(
            replace(s, segment=s.segment - (s.segment > removed)) for s in body.surfaces if s.segment != removed
        ),
        aliases={c: {s: n for s, n in names.items() if s != name} for c, names in body.aliases.items()},
        morphs=tuple(
            m for m in body.morphs  # neither on this segment, nor steered by one of its coordinates
            if getattr(m, "segment", None) != name
            and tree.owners[tree.coordinates.index(m.steering.coordinate)] != removed
        ),
        closures=without_landmarks(body.closures, left.landmarks.names),
        dimensions=tuple(d for d in body.dimensions if name not in d.moves),
    )


def with_surfaces(body: Body, segment: str, surfaces: Surface | Sequence[Surface]) -> Body:
    """Replace the surfaces of one segment; an empty sequence makes it invisible.

    The surfaces' `segment` is set to this one.
    """
    here = body.tree.segment(segment)
    new = [surfaces] if isinstance(surfaces, Surface) else list(surfaces)
    others = [s for s in body.surfaces if s.segment != here]
    both = sorted([*others, *(replace(s, segment=here) for s in new)], key=lambda s: s.segment)
    return replace(body, surfaces=tuple(both))


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> MeshSurface:
    """A box of a size (3,) [m] about a centre (3,) [m], along the axes of its segment's frame.

    Raises
    ------
    BodyError
        A size that is not three positive numbers.
    """
    sides = np.asarray(size, float)
    if sides.shape != (3,) or not (np.isfinite(sides).all() and sides.min() > 0):
        raise BodyError(f"a box of the size {size}", remedy="Give three positive lengths in metres.")
    bits = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
    faces = [triangle for a, b, c, d in _SIDES for triangle in ((a, b, c), (a, c, d))]
    return MeshSurface(0, np.asarray(centre, float) + (bits - 0.5) * sides, np.array(faces))


def carry_state(state: BodyState, old: Body, new: Body) -> BodyState:
    """Convert a state from one body to another by the names of its angles; new ones get their default value.

    Raises
    ------
    BodyError
        A state that is not of the old body.
    """
    if len(state.angles) != len(old.tree.coordinates):
        problem = f"a state with {len(state.angles)} angles for a body with {len(old.tree.coordinates)}"
        raise BodyError(problem, remedy="Give the body of this state.")
    known = dict(zip(old.tree.coordinates, state.angles))
    angles = [known.get(name, usual) for name, usual in zip(new.tree.coordinates, new.tree.usual)]
    return BodyState(state.T_world_root, np.array(angles, float))


def carry_dofs(values: NDArray, old: Body, new: Body, *, missing: float = 0.0) -> NDArray:
    """Convert values of degrees of freedom (velocities, deviations) to another body, by name.

    Parameters
    ----------
    values : (6 + D,) of the old body
    missing : float, value of new degrees of freedom

    Returns
    -------
    (6 + E,) of the new body

    Raises
    ------
    BodyError
        Values of another shape.
    """
    if np.shape(values) != (old.tree.n_dofs,):
        problem = f"values of shape {np.shape(values)} for {old.tree.n_dofs} degrees of freedom"
        raise BodyError(problem, remedy="Give one for each of the old body's.")
    known = dict(zip(old.dof_names, values))
    return np.array([known.get(name, missing) for name in new.dof_names], float)


def _with_segment(tree: KinematicTree, name: str, parent: int, joint: PartJoint) -> KinematicTree:
    k = len(joint.coordinates)
    at = np.array(joint.at, float)
    columns = {
        "axes": np.array(joint.axes, float).reshape(-1, 3),
        "prismatic": np.array(joint.slides or (False,) * k),
        "lower": np.array(joint.lower or (-np.inf,) * k, float),
        "upper": np.array(joint.upper or (np.inf,) * k, float),
        "usual": np.array(joint.usual or (0.0,) * k, float),
        "spread": np.array(joint.spread or (np.inf,) * k, float),
    }
    if mismatched := [n for n, v in columns.items() if len(v) != k]:
        problem = f"{mismatched[0].replace('prismatic', 'slides')} of its joint do not match its {k} coordinates"
        raise BodyError(problem, place=f"part {name}", remedy="Give one for each coordinate.")
    length = np.linalg.norm(columns["axes"], axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 1e-9).all() and at.shape == (3,) and np.isfinite(at).all()):
        problem = "an axis of its joint has no direction, or `at` is not three finite numbers"
        raise BodyError(problem, place=f"part {name}", remedy="Give axes of some length, and `at` in metres.")
    columns["axes"] /= length
    low, high, usual = columns["lower"], columns["upper"], columns["usual"]
    if not ((low <= usual) & (usual <= high) & np.isfinite(usual) & (columns["spread"] > 0)).all():
        problem = "its joint's usual values are outside of their limits, or a spread is not positive"
        raise BodyError(problem, place=f"part {name}", remedy="Give lower <= usual <= upper.")
    return replace(
        tree,
        segments=(*tree.segments, name),
        parents=np.append(tree.parents, parent),
        offsets=np.concatenate([tree.offsets, at[None]]),
        coordinates=(*tree.coordinates, *joint.coordinates),
        owners=np.append(tree.owners, np.full(k, len(tree.segments))),
        couplings=np.pad(tree.couplings, ((0, 0), (0, k))),
        **{n: np.concatenate([getattr(tree, n), columns[n]]) for n in COLUMNS},  # type: ignore[arg-type]
    )


def _without_segment(tree: KinematicTree, removed: int) -> KinematicTree:
    kept, own = np.arange(len(tree.segments)) != removed, tree.owners != removed
    parents, owners = tree.parents[kept], tree.owners[own]
    return replace(
        tree,
        segments=tuple(s for s, keep in zip(tree.segments, kept) if keep),
        parents=parents - (parents > removed),
        offsets=tree.offsets[kept],
        coordinates=tuple(c for c, keep in zip(tree.coordinates, own) if keep),
        owners=owners - (owners > removed),
        couplings=tree.couplings[(tree.couplings[:, ~own] == 0.0).all(axis=1)][:, own],
        **{name: getattr(tree, name)[own] for name in COLUMNS},
    )


def _remaining_points(points: PointSet, removed: int) -> PointSet:
    kept = points.segments != removed
    segments = points.segments[kept]
    names = tuple(n for n, keep in zip(points.names, kept) if keep)
    return PointSet(names, segments - (segments > removed), points.points[kept])


def _free_name(name: str, taken: tuple[str, ...]) -> str:
    while name in taken:
        name += "_part"
    return name


_SLIDES = ("tx", "ty", "tz")
_TURNS = ("rz", "rx", "ry")  # in this order the gimbal lock is at an arm raised sideways
_AXES = np.concatenate([np.eye(3), np.eye(3)[[2, 0, 1]]])


def free_parts(body: Body) -> Body:
    """Cut a body at its joints: every part has six degrees of freedom, three translations and three rotations.

    Segments keep their indices, names, surfaces and points, and all become children of the first.
    `correspondences.band_rows` replaces the joints.
    """
    tree, count = body.tree, len(body.tree.segments)
    free = 6 * (count - 1)
    return replace(
        body,
        name=f"{body.name}_parts",
        tree=KinematicTree(
            segments=tree.segments,
            parents=np.append(-1, np.zeros(count - 1, int)),
            offsets=np.concatenate([tree.rest[:1], tree.rest[1:] - tree.rest[0]]),
            coordinates=tuple(f"{name}_{axis}" for name in tree.segments[1:] for axis in _SLIDES + _TURNS),
            owners=np.repeat(np.arange(1, count), 6),
            axes=np.tile(_AXES, (count - 1, 1)),
            prismatic=np.tile([True] * 3 + [False] * 3, count - 1),
            lower=np.full(free, -np.inf),
            upper=np.full(free, np.inf),
            usual=np.zeros(free),
            spread=np.full(free, np.inf),
        ),
    )


def parts_state(parts: Body, frames: NDArray) -> BodyState:
    """State of a body of free parts from its segments' frames (S, 12), see `KinematicTree.forward`.

    Raises
    ------
    BodyError
        Frames of another number of segments.
    """
    count = len(parts.tree.segments)
    if frames.shape != (count, 12) or len(parts.tree.coordinates) != 6 * (count - 1):
        problem = f"frames of shape {frames.shape} for {count} segments, {len(parts.tree.coordinates)} angles"
        raise BodyError(problem, remedy="Give `free_parts(body)`, and frames (segments, 12).")
    R, t = frames[:, :9].reshape(-1, 3, 3), frames[:, 9:]
    rest, root = parts.tree.rest, R[0]
    joints = (R @ rest[:, :, None])[..., 0] + t
    slides = (joints[1:] - t[0]) @ root - rest[1:]
    turned = root.T @ R[1:]
    sine = np.clip(turned[:, 2, 1], -1.0, 1.0)  # R = Rz(a) Rx(b) Ry(c)
    a, b = np.arctan2(-turned[:, 0, 1], turned[:, 1, 1]), np.arcsin(sine)
    c = np.arctan2(-turned[:, 2, 0], turned[:, 2, 2])
    locked = np.abs(sine) > 1.0 - 1e-12  # gimbal lock: a and c rotate about one axis
    a = np.where(locked, np.arctan2(turned[:, 1, 0], turned[:, 0, 0]), a)
    c = np.where(locked, 0.0, c)
    return BodyState(se3.transform(root, joints[0]), np.column_stack([slides, a, b, c]).ravel())


def with_dimensions(body: Body, values: Mapping[str, float]) -> Body:
    """Change dimensions of gear to values [m] or [rad]. Everything they move shifts by the change, whatever its scale.

    Raises
    ------
    BodyError
        A dimension that the body does not have, or a value that is not finite.
    """
    known = {d.name: d for d in body.dimensions}
    for name in values:
        check_choice(f"dimension of body '{body.name}' named", name, known, BodyError, remedy="Use one of these.")
        if not np.isfinite(values[name]):
            raise BodyError(f"dimension '{name}' of {values[name]}", remedy="Give metres, or radians.")
    offsets, points = np.array(body.tree.offsets), np.array(body.landmarks.points)
    closures = {c.name: c for c in body.closures}
    moved = False
    for name, value in values.items():
        d, change = known[name], float(value) - known[name].value
        if change == 0.0:
            continue
        shift, moved = change * np.array(d.along), True
        for what in d.moves:
            if what in closures:
                closures[what] = _shifted(closures[what], shift, change * np.array(d.about))
            elif what in body.landmarks.names:
                points[body.landmarks.names.index(what)] += shift
            else:
                offsets[body.tree.segment(what)] += shift
        known[name] = replace(d, value=float(value))
    if not moved:
        return body
    landmarks = replace(body.landmarks, points=points)
    keypoints, markers = (
        {name: _moved_points(points, body.landmarks, landmarks) for name, points in sets.items()}
        for sets in (body.keypoint_sets, body.marker_sets)
    )
    return replace(
        body, tree=body.tree.with_offsets(offsets), landmarks=landmarks, keypoint_sets=keypoints, marker_sets=markers,
        closures=tuple(closures.values()), dimensions=tuple(known.values()),
    )  # fmt: skip


def _moved_points(points: PointSet, old: PointSet, new: PointSet) -> PointSet:
    """Move the points that coincide with an old landmark to the new one."""
    at = {(int(s), tuple(x)): k for k, (s, x) in enumerate(zip(old.segments, old.points))}
    out = np.array(points.points)
    for i, (s, x) in enumerate(zip(points.segments, points.points)):
        k = at.get((int(s), tuple(x)))
        if k is not None:
            out[i] = new.points[k]
    return replace(points, points=out)


def _shifted(closure: Closure, shift: NDArray, turn: NDArray) -> Closure:
    """Shift a closure's position by (3,) [m], and rotate its segment by a rotation vector (3,) [rad]."""
    out = closure
    if shift.any():
        out = replace(out, place=tuple((np.array(out.place) + shift).tolist()))
    if turn.any():
        R = se3.exp_so3(turn) @ se3.exp_so3(np.array(out.turn))
        out = replace(out, turn=tuple(se3.log_so3(R).tolist()))
    return out


def with_places(body: Body, places: Mapping[str, tuple[NDArray, NDArray]]) -> Body:
    """Replace the position (3,) [m] and rotation vector (3,) [rad] in the world of some closures."""
    out = []
    for c in body.closures:
        if c.name in places:
            at, turn = places[c.name]
            c = replace(c, place=tuple(np.asarray(at, float).tolist()), turn=tuple(np.asarray(turn, float).tolist()))
        out.append(c)
    return replace(body, closures=tuple(out))


def known_gear(body: Body) -> Body:
    """The body with all dimensions and positions in the world marked as known."""
    return replace(
        body, closures=tuple(replace(c, place_std=0.0, turn_std=0.0) for c in body.closures),
        dimensions=tuple(replace(d, std=0.0) for d in body.dimensions),
    )  # fmt: skip


def has_unknown_gear(body: Body) -> bool:
    """Whether a dimension or a position in the world is to be estimated."""
    return any(c.place_std > 0.0 for c in body.closures) or any(d.std > 0.0 for d in body.dimensions)
