"""Convert a body to plain arrays and back, without loss: for files that hold a fitted body with its motion.

S segments, D coordinates, G scale groups; names are arrays of text, indices int64, the rest float64, in metres and
radians:

    name ()  stature ()  root_free ()                  the body; stature [m]
    segments (S,)  joints (S,)  parents (S,)           parents: index, -1 for the root
    offsets (S, 3)                                     joint centre in the parent's frame at rest [m]
    coordinates (D,)  owners (D,)  axes (D, 3)         owners: segment moved; axes in the root-aligned rest frame
    prismatic (D,)  lower (D,)  upper (D,)             limits [rad] or [m], ±inf for none
    usual, spread (D,)                                 mean and standard deviation of the posture prior [rad] or [m]
    couplings (C, D)                                   correlated deviations [1/rad] or [1/m]; may be missing
    scale_groups (G,)  segment_scale (S,)
    landmarks/names (K,)  landmarks/segments (K,)  landmarks/points (K, 3)    in the segment's frame [m]
    keypoints/SET/names, segments, points              as the landmarks, one of these for every set
    markers/SET/names, segments, points
    surfaces/segments (C,)                             of every surface; of a tapered cylinder (NaN for a mesh):
    surfaces/starts, ends, sides (C, 3)                in the segment's frame [m]; sides: directions
    surfaces/radii (C, 2, 2)                           half axes at both ends [m]
    surfaces/K/vertices (V, 3), faces (T, 3)           of surface K where it is a mesh [m]
    aliases/CONVENTION (N, 2)                          pairs: segment, name in the convention
    morphs/..., skin/...                               see `serial_morphs`
    closures, dimensions                               each as JSON, fields as of `closures`; may be missing

Names that are part of a key are percent-encoded.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote, unquote

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_npz
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.closures import KINDS, Closure, Dimension
from kinefit.bodies.morphs.serial_morphs import (
    morphs_from_arrays,
    morphs_to_arrays,
    skin_from_arrays,
    skin_to_arrays,
)
from kinefit.bodies.surfaces import MeshSurface, Metaballs, Surface, TaperedCylinder
from kinefit.bodies.toml.records import stature_of
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError

_Kind = TypeVar("_Kind")
_TREE = ("parents", "offsets", "owners", "axes", "prismatic", "lower", "upper", "usual", "spread")


def body_to_arrays(body: Body) -> dict[str, NDArray]:
    """Convert a body to arrays, with the keys of the module's docstring, such as offsets (S, 3) [m]."""
    tree = body.tree
    out: dict[str, NDArray] = {
        "name": np.array(body.name),
        "stature": np.array(float(body.stature)),
        "root_free": np.array(tree.root_free),
        "segments": text_array(tree.segments),
        "joints": text_array(body.joints),
        "coordinates": text_array(tree.coordinates),
        "scale_groups": text_array(body.scale_groups),
        "segment_scale": np.array(body.segment_scale, np.int64),
    }
    out |= _surfaces_to_arrays(body.surfaces)
    out |= morphs_to_arrays(body.morphs, _surfaces_to_arrays) | skin_to_arrays(body.skin)
    out |= {name: np.array(getattr(tree, name)) for name in (*_TREE, "couplings")}
    out |= _points_to_arrays("landmarks", body.landmarks)
    for kind, sets in (("keypoints", body.keypoint_sets), ("markers", body.marker_sets)):
        for name, points in sets.items():
            out |= _points_to_arrays(f"{kind}/{quote(name, safe='')}", points)
    for key in ("closures", "dimensions"):
        if getattr(body, key):
            out[key] = text_array([msgspec.json.encode(record).decode() for record in getattr(body, key)])
    for convention, names in body.aliases.items():
        pairs = [text_array(names), text_array(names.values())]
        out[f"aliases/{quote(convention, safe='')}"] = np.stack(pairs, axis=1)
    return out


def body_from_arrays(arrays: Mapping[str, NDArray]) -> Body:
    """Body from arrays with the keys of the module's docstring, such as offsets (S, 3) [m].

    Raises
    ------
    BodyError
        An array is missing, has the wrong shape, or an index out of range.
    """
    n_segments, n_coordinates = len(_array(arrays, "segments", (None,))), len(_array(arrays, "coordinates", (None,)))
    shapes = {"offsets": (n_segments, 3), "axes": (n_coordinates, 3), "parents": (n_segments,)}
    tree = KinematicTree(
        segments=_texts(arrays, "segments"),
        coordinates=_texts(arrays, "coordinates"),
        root_free=bool(_array(arrays, "root_free", ())),
        couplings=_array(arrays, "couplings", (None, n_coordinates)) if "couplings" in arrays else np.empty((0, 0)),
        **{name: _array(arrays, name, shapes.get(name, (n_coordinates,))) for name in _TREE},  # type: ignore[arg-type]
    )
    _check_indices(tree.owners, n_segments, "owners")
    if n_segments == 0 or tree.parents[0] != -1:
        raise BodyError("the first segment is not the root")
    _check_indices(tree.parents[1:], n_segments, "parents")
    groups, segment_scale = _texts(arrays, "scale_groups"), _array(arrays, "segment_scale", (n_segments,))
    _check_indices(segment_scale, len(groups), "segment_scale")
    body = Body(
        name=str(_array(arrays, "name", ())),
        tree=tree,
        joints=_texts(arrays, "joints", n_segments),
        scale_groups=groups,
        segment_scale=segment_scale,
        landmarks=_points_from_arrays(arrays, "landmarks", n_segments),
        keypoint_sets=_sets(arrays, "keypoints", n_segments),
        marker_sets=_sets(arrays, "markers", n_segments),
        surfaces=_surfaces_from_arrays(arrays, n_segments),
        aliases={
            unquote(key.split("/")[1]): {str(a): str(b) for a, b in _array(arrays, key, (None, 2))}
            for key in arrays
            if key.startswith("aliases/")
        },
        stature=stature_of(float(_array(arrays, "stature", ()))),
        morphs=morphs_from_arrays(arrays, lambda own: _surfaces_from_arrays(own, n_segments)),
        skin=skin_from_arrays(arrays, n_segments),
        closures=_decoded(arrays, "closures", Closure),
        dimensions=_decoded(arrays, "dimensions", Dimension),
    )
    return _check_closures(body)


@checked
def save_body(body: Body, path: str | PathLike[str]) -> None:
    """Write a body, skin and morphs included, to an `.npz` file that `load_body` and takes read.

    Raises
    ------
    BodyError
        A name that does not end in .npz, or a file that cannot be written; an older file is then kept.
    """
    target = Path(path)
    if target.suffix != ".npz":
        raise BodyError("a body is saved as .npz", file=path, remedy=f"Call it {target.stem}.npz.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".writing-") as folder:
            np.savez_compressed(Path(folder) / target.name, **body_to_arrays(body))  # type: ignore[arg-type]
            (Path(folder) / target.name).replace(target)
    except OSError as error:
        remedy = "Choose a folder with write permission and free space."
        raise BodyError(f"cannot write the body ({error.strerror or error})", file=path, remedy=remedy) from error


def saved_body(path: str | PathLike[str]) -> Body:
    """Load a body that `save_body` wrote.

    Raises
    ------
    BodyError
        A file that cannot be read, or that holds no body.
    """
    remedy = "Give a file written by save_body, or a body file in TOML."
    arrays = read_npz(path, remedy=remedy, error=BodyError)
    try:
        return body_from_arrays(arrays)
    except BodyError as error:
        raise BodyError(error.problem, file=path, place=error.place, remedy=error.remedy or remedy) from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise BodyError(f"cannot read the body ({error})", file=path, remedy=remedy) from error


def text_array(names: object) -> NDArray:
    """Array (N,) of text, also for N = 0."""
    return np.array(list(names), dtype=np.str_)  # type: ignore[call-overload]


_BALL_FIELDS = ("centres", "radii", "weights", "axes")


def _surfaces_to_arrays(surfaces: tuple[Surface, ...]) -> dict[str, NDArray]:
    count = len(surfaces)
    out = {"surfaces/segments": np.array([c.segment for c in surfaces], np.int64)}
    out |= {f"surfaces/{name}": np.full((count, 3), np.nan) for name in ("starts", "ends", "sides")}
    out["surfaces/radii"] = np.full((count, 2, 2), np.nan)
    for k, surface in enumerate(surfaces):
        if isinstance(surface, TaperedCylinder):
            for name in ("starts", "ends", "sides"):
                out[f"surfaces/{name}"][k] = getattr(surface, name[:-1])
            out["surfaces/radii"][k] = surface.radii
        elif isinstance(surface, Metaballs):
            out |= {f"surfaces/{k}/{name}": np.array(getattr(surface, name)) for name in _BALL_FIELDS}
        else:
            out |= {f"surfaces/{k}/{name}": np.array(getattr(surface, name)) for name in ("vertices", "faces")}
    return out


def _surfaces_from_arrays(arrays: Mapping[str, NDArray], n_segments: int) -> tuple[Surface, ...]:
    owners = _array(arrays, "surfaces/segments", (None,))
    _check_indices(owners, n_segments, "surfaces/segments")
    count, out = len(owners), list[Surface]()
    ends = _array(arrays, "surfaces/ends", (count, 3))
    if "surfaces/starts" not in arrays:  # older files, with round cylinders: two radii, from the joint
        radii = _array(arrays, "surfaces/radii", (count, 2))
        return tuple(TaperedCylinder.round(int(s), e, (r[0], r[1])) for s, e, r in zip(owners, ends, radii))
    starts, sides = (_array(arrays, f"surfaces/{name}", (count, 3)) for name in ("starts", "sides"))
    radii = _array(arrays, "surfaces/radii", (count, 2, 2))
    for k, segment in enumerate(owners):
        if f"surfaces/{k}/centres" in arrays:
            shapes = (None, 3), (None, 3), (None,), (None, 3, 3)
            balls = [_array(arrays, f"surfaces/{k}/{name}", shape) for name, shape in zip(_BALL_FIELDS, shapes)]
            out.append(Metaballs.of(int(segment), *balls))
        elif f"surfaces/{k}/vertices" in arrays:
            vertices, faces = (_array(arrays, f"surfaces/{k}/{name}", (None, 3)) for name in ("vertices", "faces"))
            out.append(MeshSurface(int(segment), vertices, faces))
        else:
            numbers = (v[k].tolist() for v in (starts, ends, radii, sides))
            out.append(TaperedCylinder(int(segment), *numbers))
    return tuple(out)


def _points_to_arrays(key: str, points: PointSet) -> dict[str, NDArray]:
    arrays = {"names": text_array(points.names), "segments": points.segments, "points": points.points}
    return {f"{key}/{name}": np.array(array) for name, array in arrays.items()}


def _points_from_arrays(arrays: Mapping[str, NDArray], key: str, n_segments: int) -> PointSet:
    names = _texts(arrays, f"{key}/names")
    segments = _array(arrays, f"{key}/segments", (len(names),))
    _check_indices(segments, n_segments, f"{key}/segments")
    points = _array(arrays, f"{key}/points", (len(names), 3))
    if not (finite := np.isfinite(points).all(axis=1)).all():
        place = f"{key}, {names[np.argmin(finite)]}"
        raise BodyError("a point that is not finite", place=place, remedy="Give three numbers in metres.")
    return PointSet(names, segments, points)


def _sets(arrays: Mapping[str, NDArray], kind: str, n_segments: int) -> dict[str, PointSet]:
    keys = dict.fromkeys(key.split("/")[1] for key in arrays if key.startswith(f"{kind}/"))
    return {unquote(key): _points_from_arrays(arrays, f"{kind}/{key}", n_segments) for key in keys}


def _decoded(arrays: Mapping[str, NDArray], key: str, kind: type[_Kind]) -> tuple[_Kind, ...]:
    """Closures or dimensions from JSON; empty for older files."""
    if key not in arrays:
        return ()
    try:
        return tuple(msgspec.json.decode(str(text), type=kind) for text in _array(arrays, key, (None,)))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BodyError(f"{key} that cannot be read ({error})") from error


def _check_closures(body: Body) -> Body:
    for c in body.closures:
        points = (c.point, *([c.to] if c.to else []))
        if c.kind not in KINDS or any(p not in body.landmarks.names for p in points):
            raise BodyError(f"closure '{c.name}' has an unknown kind or unknown landmarks")
    return body


def _array(arrays: Mapping[str, NDArray], key: str, shape: tuple[int | None, ...]) -> NDArray:
    if key not in arrays:
        raise BodyError(f"no array '{key}'")
    array = arrays[key]
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape)):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise BodyError(f"array '{key}' has shape {array.shape} instead of ({expected})")
    return array


def _texts(arrays: Mapping[str, NDArray], key: str, count: int | None = None) -> tuple[str, ...]:
    return tuple(str(v) for v in _array(arrays, key, (count,)))


def _check_indices(indices: NDArray, count: int, key: str) -> None:
    if indices.size and not (np.min(indices) >= 0 and np.max(indices) < count):
        remedy = f"Its indices run from 0 to {count - 1}."
        raise BodyError(f"array '{key}' has an index out of range", remedy=remedy)
