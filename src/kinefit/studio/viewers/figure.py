"""One body in the scene: skin, bones, joints, surfaces, landmarks and their uncertainty. Thin calls of viser."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.motion import BELIEVED
from kinefit.bodies.rendering import looks
from kinefit.bodies.rendering.looks import body_mesh
from kinefit.geometry import se3
from kinefit.studio.viewers import scene as content

PARTS = ("skin", "bones", "joints", "surface", "landmarks", "uncertainty")
"""Layers of a figure."""

DEFAULT_PARTS, CYLINDERS = frozenset({"skin"}), frozenset({"bones", "joints", "surface"})
"""Those that are shown at first, and those that show the cylinders of the fit instead."""

_SURFACE_OPACITY, _ELLIPSOID = 0.22, (150, 60, 230)
_SEEN_THROUGH = 0.5  # opacity of the skin before a camera's image


class Figure:
    """A body whose segments can be moved; everything rigid hangs on the segments' frames.

    Parameters
    ----------
    scene : viser's scene
    name : str
        Of the node, unique in the scene.
    body : Body
    colour : (r, g, b), optional
        One for all; by default left and right differ.
    """

    def __init__(self, scene: Any, name: str, body: Body, *, colour: content.RGB | None = None) -> None:
        self.body = body
        S = len(body.tree.segments)
        self.base_colours = looks.side_colours(body) if colour is None else np.tile(np.array(colour, np.uint8), (S, 1))
        self._root = scene.add_frame(f"/world/{name}", show_axes=False)
        self._segments = [scene.add_frame(f"/world/{name}/{s}", show_axes=False) for s in body.tree.segments]
        self._parts: dict[str, list[Any]] = {part: [] for part in PARTS}
        self._on, self._dashes = set(PARTS), list[Any]()  # layers that are shown; a lost segment's line, on a skin, too
        self._looks: list[tuple[Any, ...]] = [()] * S
        self._shaded: list[list[tuple[Any, str, float]]] = [[] for _ in range(S)]  # node, its part, full opacity
        self._followers: list[tuple[Any, int]] = []  # bones of the skin's pieces, and their segments
        self._add_skin(scene, name)
        self._bare = bare = not self._parts["skin"]  # a body without surfaces: its bones stand for the skin
        balls = [_ball(radius) for radius in content.joint_radii(body)]
        (dashes, gaps), surfaces = content.bone_meshes(body), content.surface_meshes(body)
        for s, segment in enumerate(body.tree.segments):
            at, shade = f"/world/{name}/{segment}", tuple(int(v) for v in self.base_colours[s])
            for part, mesh, more in (
                ("bones", dashes[s], {}),
                ("gaps", gaps[s], {}),
                ("surface", surfaces[s], {"opacity": _SURFACE_OPACITY, "cast_shadow": False, "receive_shadow": False}),
                ("joints", balls[s], {}),
            ):
                if mesh is None:
                    continue
                colour_of: Any = (245, 245, 245) if part == "joints" else shade
                node = scene.add_mesh_simple(f"{at}/{part}", mesh.vertices, mesh.faces, color=colour_of, **more)
                layer = "skin" if bare and part != "surface" else "bones" if part == "gaps" else part
                self._parts[layer].append(node)
                self._dashes += [node] if part == "bones" else []
                if part != "joints":
                    self._shaded[s].append((node, part, float(more.get("opacity", 1.0))))
            mine = body.landmarks.points[body.landmarks.segments == s]
            if len(mine):
                at = f"{at}/landmarks"
                self._parts["landmarks"].append(_balls(scene, at, mine, 0.008, (250, 220, 60)))
        unit = _ball(1.0)  # one node each: browsers rebuild batched ones too slowly for a moving scene
        self._centres = [scene.add_frame(f"/world/{name}/at_{n}", show_axes=False) for n in body.tree.segments]
        self._parts["uncertainty"] = [
            scene.add_mesh_simple(
                f"/world/{name}/at_{n}/uncertainty", unit.vertices, unit.faces, color=_ELLIPSOID, opacity=0.4,
                cast_shadow=False, receive_shadow=False,
            )
            for n in body.tree.segments
        ]  # fmt: skip

    def _add_skin(self, scene: Any, name: str) -> None:
        """Add the skin, a mesh for each segment, so that each can have its own colour and opacity."""
        rest = self.body.tree.rest
        for piece in looks.skin_pieces(body_mesh(self.body)):
            unturned = np.tile([1.0, 0.0, 0.0, 0.0], (len(piece.followed), 1))
            node = scene.add_mesh_skinned(
                f"/world/{name}/skin_{self.body.tree.segments[piece.segment]}", piece.mesh.vertices, piece.mesh.faces,
                bone_wxyzs=unturned, bone_positions=rest[piece.followed], skin_weights=piece.weights,
                color=tuple(int(v) for v in self.base_colours[piece.segment]),
            )  # fmt: skip
            self._parts["skin"].append(node)
            self._shaded[piece.segment].append((node, "skin", 1.0))
            self._followers += zip(node.bones, piece.followed.tolist(), strict=True)

    def show(self, part: str, visible: bool) -> None:
        """Show or hide one of `PARTS`, from the next pose on."""
        (self._on.add if visible else self._on.discard)(part)
        for node in self._parts[part]:
            node.visible = visible
        for node in self._dashes:
            node.visible = bool(self._on & {"skin", "bones"})

    def show_all(self, visible: bool) -> None:
        """Show or hide the whole figure."""
        self._root.visible = visible

    def blank(self) -> None:
        """Leave nothing that the next pose would not set: a recording that plays in a loop has to set all of it."""
        self._looks = [()] * len(self._looks)
        for node, _, _ in (shaded for of in self._shaded for shaded in of):
            node.color, node.opacity = (0, 0, 0), 0.0
        for node in self._parts["uncertainty"]:
            node.scale = (1e-6,) * 3

    def pose(
        self,
        Ts_world_segment: NDArray,
        *,
        joint_std: NDArray | None = None,
        quality: NDArray | None = None,
        by_quality: bool = False,
        see_through: bool = False,
    ) -> None:
        """Move the segments to poses (S, 4, 4), with the joints' standard deviations (S, 3) [m] and qualities (S,).

        With `see_through` the skin lets the image behind it show.
        """
        wxyz, x = se3.quaternion(Ts_world_segment[:, :3, :3]), Ts_world_segment[:, :3, 3]
        for node, q, t in zip(self._segments, wxyz, x, strict=True):
            node.wxyz, node.position = q, t
        for bone, s in self._followers:
            bone.wxyz, bone.position = wxyz[s], x[s]
        uncertain = None if joint_std is None else looks.uncertain_segments(self.body, joint_std)
        colours, opacities = looks.segment_looks(
            np.ones(len(x)) if quality is None else quality, self.base_colours, uncertain=uncertain,
            by_quality=by_quality and quality is not None,
        )  # fmt: skip
        bones = self._bare or "bones" in self._on
        for s, (colour, opacity) in enumerate(zip(colours.tolist(), opacities.tolist(), strict=True)):
            if self._looks[s] != (*colour, opacity, see_through, bones):
                self._looks[s] = (*colour, opacity, see_through, bones)
                lost = quality is not None and quality[s] < BELIEVED
                hidden = {"gaps"} if lost else set() if bones else {"bones"}
                for node, part, full in self._shaded[s]:
                    full = 0.0 if part in hidden else _SEEN_THROUGH if part == "skin" and see_through else full
                    share = full * (1.0 if part in ("bones", "gaps") else opacity)
                    node.color, node.opacity = tuple(colour), None if share == 1.0 else share
        axes = np.zeros((len(x), 3)) if joint_std is None else content.ellipsoids(self.body, joint_std)
        steps = 1.1 ** np.rint(np.log(np.maximum(axes, 1e-5)) / np.log(1.1))  # sizes cost a browser more than moves
        for centre, t in zip(self._centres, x, strict=True):
            centre.position = t
        for node, half in zip(self._parts["uncertainty"], steps.tolist(), strict=True):
            if node.scale != tuple(half):
                node.scale = tuple(half)


class ScenePoints:
    """Points that no segment carries, one small ball each.

    Parameters
    ----------
    scene : viser's scene
    name : str
        Of the node, unique in the scene.
    count : int
    colour : (r, g, b)
    radius : float [m]
    """

    def __init__(self, scene: Any, name: str, count: int, colour: content.RGB, *, radius: float = 0.012) -> None:
        ball = _ball(radius)
        self._root = scene.add_frame(f"/world/{name}", show_axes=False)
        self._balls = [
            scene.add_mesh_simple(f"/world/{name}/{k}", ball.vertices, ball.faces, color=colour) for k in range(count)
        ]

    def show(self, points: NDArray | None) -> None:
        """Points (count, 3) [m], NaN where unknown; None hides all."""
        self._root.visible = points is not None
        if points is None:
            return
        for ball, x, known in zip(self._balls, points, np.isfinite(points).all(axis=-1), strict=True):
            ball.visible = bool(known)
            if known:
                ball.position = x


def _ball(radius: float) -> looks.Mesh:
    """A small sphere about the origin."""
    return content.capsule(np.zeros(3), np.zeros(3), (radius, radius))


def _balls(scene: Any, name: str, points: NDArray, radius: float, colour: content.RGB) -> Any:
    """Spheres (N, 3) in one node."""
    ball, N = _ball(radius), len(points)
    unturned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (N, 1))
    return scene.add_batched_meshes_simple(
        name, ball.vertices, ball.faces, unturned, np.asarray(points, np.float32), batched_colors=colour, lod="off"
    )
