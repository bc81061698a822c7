"""Convert morphs and skin of a body to plain arrays and back, for `serial`.

    morphs/K/kind ()                         "joint", "global", "surface" or "local"; K counts from 0
    morphs/K/angle ()  span (2,)  beyond ()  coordinate; its values of weight 0 and 1 [rad] or [m]
    morphs/K/weight () or (N, 2)             name of the weighting, or t and ω (functions are stored as a table)
    morphs/K/segment ()                      "" for none
    morphs/K/twist (6,)                      of a joint's motion
    morphs/K/target (V, 3)                   of a global morph [m]
    morphs/K/centre, radii (n,)  shift (3,)  on (N,)    of a local morph [m]
    morphs/K/moves ()                        whether it moves with its segment; default false, for older files
    morphs/K/surfaces/...                    of a segment's second shape, as those of a body
    skin/nodes (V, K, 3)  faces (T, 3)  owners, weights (V, K)

A skin's K is that of its owners.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, Operator, SegmentMorph
from kinefit.bodies.morphs.steering import Steering
from kinefit.bodies.surfaces import Surface
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh
from kinefit.errors import BodyError

_TABLE_ROWS = 1025  # of a stored weighting function
_SKIN = ("nodes", "faces", "owners", "weights")
_KINDS = {JointMotion: "joint", GlobalMorph: "global", SegmentMorph: "surface", LocalMorph: "local"}
_OWN = {"joint": ("twist",), "global": ("target",), "surface": (), "local": ("centre", "radii", "shift")}

ToArrays = Callable[[tuple[Surface, ...]], dict[str, NDArray]]
FromArrays = Callable[[Mapping[str, NDArray]], tuple[Surface, ...]]


def morphs_to_arrays(morphs: tuple[Operator, ...], surfaces: ToArrays) -> dict[str, NDArray]:
    """Convert morphs to arrays, with the keys and shapes such as span (2,) of the module's docstring.

    surfaces: converts surfaces to arrays.
    """
    out: dict[str, NDArray] = {}
    for k, morph in enumerate(morphs):
        kind, s = _KINDS[type(morph)], morph.steering
        own = {
            "kind": np.array(kind), "angle": np.array(s.coordinate), "span": np.array([s.start, s.end], float),
            "beyond": np.array(s.beyond), "weight": _weight(s),
            "segment": np.array(getattr(morph, "segment", "") or ""),
        }  # fmt: skip
        own |= {name: np.array(getattr(morph, name), float) for name in _OWN[kind]}
        if isinstance(morph, LocalMorph):
            own["on"], own["moves"] = np.array(list(morph.on), dtype=np.str_), np.array(morph.moves)
        if isinstance(morph, SegmentMorph):
            own |= surfaces(morph.surfaces)
        out |= {f"morphs/{k}/{name}": array for name, array in own.items()}
    return out


def _weight(steering: Steering) -> NDArray:
    if isinstance(steering.weight, str):
        return np.array(steering.weight)
    if not callable(steering.weight):
        return np.array(steering.weight, float)
    t = np.linspace(0.0, 1.0, _TABLE_ROWS)
    return np.stack([t, [float(steering.weight(float(x))) for x in t]], 1)


def morphs_from_arrays(arrays: Mapping[str, NDArray], surfaces: FromArrays) -> tuple[Operator, ...]:
    """Morphs from arrays with the keys and shapes such as span (2,) of the module's docstring.

    Raises
    ------
    BodyError
        A missing array, or an unknown kind.
    """
    out: list[Operator] = []
    while f"morphs/{len(out)}/kind" in arrays:
        prefix = f"morphs/{len(out)}/"
        own = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        try:
            out.append(_morph(own, surfaces))
        except (KeyError, ValueError, TypeError) as error:
            raise BodyError(f"arrays of morph {len(out)} are wrong ({error})") from error
    return tuple(out)


def _morph(own: Mapping[str, NDArray], surfaces: FromArrays) -> Operator:
    kind, segment, weight = str(own["kind"]), str(own["segment"]), own["weight"]
    start, end = (float(v) for v in own["span"])
    weighting = str(weight) if weight.dtype.kind == "U" else weight
    for name in _OWN.get(kind, ()):
        if np.isnan(own[name]).any() or (name != "radii" and np.isinf(own[name]).any()):  # radii: inf means everywhere
            raise ValueError(f"{name} is not finite")
    steering = Steering(str(own["angle"]), start, end, weighting, bool(own["beyond"]))
    if kind == "joint":
        return JointMotion(segment, own["twist"], steering)
    if kind == "global":
        return GlobalMorph(own["target"], steering)
    if kind == "surface":
        return SegmentMorph(segment, surfaces(own), steering)
    if kind == "local":
        on = tuple(str(name) for name in own["on"])
        moves = bool(own.get("moves", False))
        return LocalMorph(own["centre"], own["radii"], own["shift"], steering, segment or None, on, moves)
    raise BodyError(f"a morph of an unknown kind '{kind}'")


def skin_to_arrays(skin: SkinnedMesh | None) -> dict[str, NDArray]:
    """Convert a skin to arrays nodes (V, K, 3) [m], faces (T, 3), owners and weights (V, K); empty without a skin."""
    return {f"skin/{name}": np.array(getattr(skin, name)) for name in _SKIN} if skin is not None else {}


def skin_from_arrays(arrays: Mapping[str, NDArray], n_segments: int) -> SkinnedMesh | None:
    """Skin from the arrays of `skin_to_arrays`, such as nodes (V, K, 3) [m]; None without arrays.

    Raises
    ------
    BodyError
        A missing array, or an index of a segment out of range.
    """
    if not any(key.startswith("skin/") for key in arrays):
        return None
    missing = [name for name in _SKIN if f"skin/{name}" not in arrays]
    if missing:
        raise BodyError(f"no array 'skin/{missing[0]}'")
    skin = SkinnedMesh(*(arrays[f"skin/{name}"] for name in _SKIN))
    if skin.owners.size and skin.owners.max() >= n_segments:
        raise BodyError("array 'skin/owners' names a segment that the body lacks")
    return skin
