"""Skinned triangle meshes: every node follows one segment, or several (linear blend skinning).

x_world = Σ_k w_k (R_k x_k + t_k). If one segment owns a node, its joints are P1's joint list 𝒥 (2.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._files import metres_of, read_text
from kinefit.bodies.surfaces.mesh import MAX_LENGTH, BodyMesh, check_triangles, read_obj
from kinefit.bodies.surfaces.skins import _kernels_skinning as kernels
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, located

if TYPE_CHECKING:
    from kinefit.bodies.tree import KinematicTree

_MAX_WEIGHT_ERROR = 1e-3  # of a sum of weights, by rounding; they are then normalised


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """Triangle mesh blended between segments.

    Parameters
    ----------
    nodes : (V, K, 3) [m]
        Position of each node in the root frame at rest, for each of its K owners; all equal if modelled at rest.
    faces : (T, 3) int32, outward counter-clockwise.
    owners : (V, K) int32, segments.
    weights : (V, K), 0 for unused owners; those of a node sum to 1.

    Raises
    ------
    BodyError
        Weights below zero, not finite, or that do not sum to one; arrays that do not match.
    """

    nodes: NDArray
    faces: NDArray
    owners: NDArray
    weights: NDArray

    def __post_init__(self) -> None:
        nodes, weights = np.array(self.nodes, float), np.array(self.weights, float)
        owners, faces = np.array(self.owners), np.array(self.faces)
        if nodes.ndim != 3 or nodes.shape[2] != 3 or owners.shape != nodes.shape[:2] or weights.shape != owners.shape:
            problem = f"a skin of nodes {nodes.shape}, owners {owners.shape} and weights {weights.shape}"
            raise BodyError(problem, remedy="Give (V, K, 3), (V, K) and (V, K).")
        known = not faces.size or 0 <= faces.min() <= faces.max() < len(nodes)
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not known:
            raise BodyError(f"a skin of {len(nodes)} nodes has faces {faces.shape} of others", remedy="Count from 0.")
        if not np.isfinite(nodes).all():
            bad = int(np.flatnonzero(~np.isfinite(nodes).all((1, 2)))[0])
            raise BodyError(f"node {bad} of a skin is not finite", remedy="Remove it and its faces.")
        total = weights.sum(1)
        wrong = np.flatnonzero(~((np.abs(total - 1.0) < _MAX_WEIGHT_ERROR) & (weights >= 0.0).all(1)))
        if len(wrong):
            problem = f"weights of {len(wrong)} nodes do not sum to one or are below zero, the first "
            problem += f"{np.round(weights[wrong[0]], 4).tolist()} of node {wrong[0]}"
            raise BodyError(problem, remedy="Normalise them: in Blender, Weights, Normalize All.")
        if owners.size and owners.min() < 0:
            raise BodyError("a skin's owner below 0", remedy="Give indices of segments, with weight 0 where unused.")
        for name, array, dtype in (
            ("nodes", nodes, float), ("faces", faces, np.int32), ("owners", owners, np.int32),
            ("weights", weights / total[:, None], float),
        ):  # fmt: skip
            value: NDArray = np.ascontiguousarray(array, dtype)
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def of(
        cls, vertices: ArrayLike, faces: ArrayLike, weights: ArrayLike, tree: KinematicTree, *, owners: int = 4
    ) -> SkinnedMesh:
        """Skin from vertices (V, 3) [m] in the root frame at rest, faces (T, 3) and weights (V, S) of all segments.

        Parameters
        ----------
        owners : int, largest number of segments of a node; those with the largest weights are kept.

        Raises
        ------
        BodyError
            As the class; faces with opposite orientations, parts inside out, holes.
        """
        x, w = np.asarray(vertices, float), np.asarray(weights, float)
        if x.ndim != 2 or x.shape[1] != 3 or w.shape != (len(x), len(tree.segments)):
            problem = f"vertices {x.shape} with weights {w.shape} for {len(tree.segments)} segments"
            raise BodyError(problem, remedy="Give (V, 3) and (V, S).")
        which, share = strongest(w, owners)
        skin = cls(np.repeat(x[:, None], which.shape[1], 1), np.asarray(faces), which, share)
        check_triangles(skin.vertices, skin.faces)
        return skin

    @classmethod
    def of_mesh(cls, mesh: BodyMesh) -> SkinnedMesh:
        """Skin from a mesh whose nodes each have one owner."""
        weights = np.ones((len(mesh.vertices), 1))
        return cls(mesh.vertices[:, None], mesh.faces, mesh.segment[:, None], weights)

    @cached_property
    def vertices(self) -> NDArray:
        """Nodes (V, 3) [m] in the root frame at rest."""
        return np.einsum("vk,vki->vi", self.weights, self.nodes)

    @cached_property
    def segment(self) -> NDArray:
        """Segment (V,) int32 with the largest weight of each node."""
        return np.take_along_axis(self.owners, self.weights.argmax(1)[:, None], 1)[:, 0]

    @cached_property
    def face_segment(self) -> NDArray:
        """Segment (T,) int32 of each face: that of two of its corners, or of the first."""
        a, b, c = self.segment[self.faces].T
        return np.where(b == c, b, a)

    def joint_list(self, node: int, tree: KinematicTree) -> tuple[int, ...]:
        """Joint list 𝒥 (P1 2.4): the coordinates that move a node, from the root on; of all its owners."""
        wanted: set[int] = set()
        for segment in self.owners[node][self.weights[node] > 0]:
            s = int(segment)
            while s >= 0:
                wanted |= set(range(tree.dof_start[s], tree.dof_start[s + 1]))
                s = int(tree.parents[s])
        return tuple(sorted(wanted))

    def posed(self, frames: NDArray, shift: NDArray | None = None) -> NDArray:
        """Nodes (V, 3) [m] in the world; frames (S, 12) of `KinematicTree.forward`, shift (V, 3) [m] of rest nodes."""
        nodes = self.nodes if shift is None else self.nodes + shift[:, None]
        out = np.empty((len(nodes), 3))
        kernels.posed(nodes, self.owners, self.weights, frames, out)
        return out

    def stretched(self, old: NDArray, new: NDArray, factors: NDArray) -> SkinnedMesh:
        """The skin on segments scaled by factors (S,), with joints moved from old to new (S, 3) [m]."""
        k = self.owners
        return SkinnedMesh(new[k] + factors[k][..., None] * (self.nodes - old[k]), self.faces, k, self.weights)


def strongest(weights: NDArray, owners: int) -> tuple[NDArray, NDArray]:
    """The owners (V, K) with the largest of weights (V, S), and their weights (V, K), scaled to the same sum."""
    count = min(max(owners, 1), weights.shape[1])
    which = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    share = np.take_along_axis(weights, which, 1)
    whole, kept = weights.sum(1, keepdims=True), share.sum(1, keepdims=True)
    share = share * np.where(kept > 0, whole / np.where(kept > 0, kept, 1.0), 0.0)
    used = max(int((share > 0).sum(1).max(initial=1)), 1)
    return which[:, :used], share[:, :used]


class SkinRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[skin]`: an OBJ file in the root's frame at rest, and a CSV file of weights, relative to the body file."""

    mesh: str
    weights: str
    unit: str = "m"
    owners: Annotated[int, msgspec.Meta(ge=1)] = 4


def skin_of(record: SkinRecord | None, tree: KinematicTree, source: str) -> SkinnedMesh | None:
    """Read the skin of a body file; `source` is the body file. None without a record.

    Raises
    ------
    BodyError
        Files that cannot be read, an unknown unit, segment or vertex, a duplicate weight; a mesh with holes or flipped
        faces, weights that do not sum to one (see `SkinnedMesh`).
    """
    if record is None:
        return None
    mesh, table = (Path(source).parent / name for name in (record.mesh, record.weights))
    with located(source, "skin"):
        metres = metres_of(record.unit, BodyError, remedy="Use one of these.")
        vertices, faces = read_obj(mesh)
        vertices = metres * vertices
        if (size := float(np.ptp(vertices, axis=0).max())) > MAX_LENGTH:
            remedy = 'State the unit of its file, such as unit = "mm".'
            raise BodyError(f"the skin is {size:.4g} m long", file=mesh, remedy=remedy)
        weights = read_weights(table, len(vertices), tree)
        try:
            return SkinnedMesh.of(vertices, faces, weights, tree, owners=record.owners)
        except BodyError as error:
            file = table if "weights" in error.problem else mesh
            raise BodyError(error.problem, file=file, remedy=error.remedy) from error


def read_weights(path: Path, count: int, tree: KinematicTree) -> NDArray:
    """Read weights (V, S) from a CSV file: lines of vertex (counted from 1, as in OBJ files), segment, weight.

    Without a weight the segment owns the vertex alone, as in P1's joint list. A header line is skipped.

    Raises
    ------
    BodyError
        A file that cannot be read, an invalid line, an unknown segment or vertex, a duplicate weight.
    """
    remedy = "Give the path of a CSV file with lines of vertex, segment, weight."
    text = read_text(path, "the weights", remedy=remedy, error=BodyError)
    lines = [line.split(",") for line in text.splitlines()]
    out = np.full((count, len(tree.segments)), np.nan)
    for number, line in enumerate(lines, 1):
        cells = [cell.strip(' \t"') for cell in line]
        if not any(cells) or (number == 1 and not cells[0].isdigit()):
            continue
        with located(path, f"line {number}"):
            try:
                vertex, segment = int(cells[0]), cells[1]
                weight = float(cells[2]) if len(cells) > 2 and cells[2] else 1.0
            except (ValueError, IndexError) as error:
                remedy = "A line has a vertex counted from 1, a segment, and a weight."
                raise BodyError(f"not a weight: '{','.join(line)[:60]}'", remedy=remedy) from error
            check_choice("segment", segment, tree.segments, BodyError, remedy="Use one of these.")
            s, known = tree.segments.index(segment), 1 <= vertex <= count
            if not known or not np.isnan(out[vertex - 1, s]):
                problem = f"vertex {vertex} of {count} " + ("twice" if known else "is not there")
                raise BodyError(problem, remedy="Give each of the mesh's vertices, from 1, once.")
        out[vertex - 1, s] = weight
    return np.nan_to_num(out, nan=0.0)


def check_closed(faces: NDArray) -> None:
    """Check that a net of quadrilaterals (Q, 4) is closed and consistently oriented.

    Raises
    ------
    BodyError
        An edge without a twin in the opposite direction.
    """
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    size = int(faces.max()) + 1
    code, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    alone = np.setdiff1d(code, back)
    if len(alone) or len(np.unique(code)) < len(code):
        problem = f"a net of {len(faces)} faces is not closed: {len(alone)} edges have no twin"
        raise BodyError(problem, remedy="Every edge needs two faces that both look outwards.")


def subdivided(values: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Subdivide a closed net (Q, 4) with values (V, K) of its vertices once: values (V', K), faces (4 Q, 4).

    The first V vertices are the old ones; those of faces and then those of edges follow.
    """
    V, Q = len(values), len(faces)
    edges, of = _edges(faces)
    centre = values[faces].mean(axis=1)
    ends = values[edges[:, 0]] + values[edges[:, 1]]
    neighbour_sum = np.zeros_like(ends)
    np.add.at(neighbour_sum, of.ravel(), centre.repeat(4, axis=0))
    n = np.bincount(edges.ravel(), minlength=V)[:, None].astype(float)
    about, middles = np.zeros_like(values), np.zeros_like(values)
    np.add.at(about, faces.ravel(), centre.repeat(4, axis=0))
    np.add.at(middles, edges.ravel(), 0.5 * ends.repeat(2, axis=0))
    corners = (about / n + 2.0 * middles / n + (n - 3.0) * values) / n
    of = V + Q + of
    middle = V + np.arange(Q)
    quads = [np.stack([faces[:, k], of[:, k], middle, of[:, (k + 3) % 4]], axis=1) for k in range(4)]
    return np.concatenate([corners, centre, 0.25 * (ends + neighbour_sum)]), np.concatenate(quads)


def limit(values: NDArray, faces: NDArray) -> NDArray:
    """Limits (V, K) of the vertices of a closed net under infinite subdivision, from values (V, K), faces (Q, 4)."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None].astype(float)
    neighbour_sum, across = np.zeros_like(values), np.zeros_like(values)
    np.add.at(neighbour_sum, edges[:, 0], values[edges[:, 1]])
    np.add.at(neighbour_sum, edges[:, 1], values[edges[:, 0]])
    np.add.at(across, faces.ravel(), values[np.roll(faces, 2, axis=1).ravel()])
    return np.asarray((n * n * values + 4.0 * neighbour_sum + across) / (n * (n + 5.0)))


def interpolated(targets: NDArray, faces: NDArray, rounds: int = 2) -> NDArray:
    """Control points (V, 3) [m] whose limits are approximately `targets` (V, 3) [m]: a patch lies inside of them."""
    control = np.array(targets)
    for _ in range(rounds):
        control += targets - limit(control, faces)
    return control


def spread(values: NDArray, faces: NDArray, rounds: int) -> NDArray:
    """Smooth values (V, K): each becomes half itself and half its neighbours' mean, `rounds` times."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None]
    for _ in range(rounds):
        neighbour_sum = np.zeros_like(values)
        np.add.at(neighbour_sum, edges[:, 0], values[edges[:, 1]])
        np.add.at(neighbour_sum, edges[:, 1], values[edges[:, 0]])
        values = 0.5 * (values + neighbour_sum / n)
    return values


def _edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """Edges (E, 2) of faces (Q, 4), and the index (Q, 4) of each face's edge from its corner k to the next."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    edges, of = np.unique(pairs, axis=0, return_inverse=True)
    return edges, of.reshape(faces.shape)
