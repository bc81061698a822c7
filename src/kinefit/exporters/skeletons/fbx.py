"""Animated figures with their skin as FBX, for Blender, Unity, Unreal and other programs of animation.

The owner of the format does not document it. What is written here follows the records that its readers agree on: the
binary file of version 7.5, nodes with typed properties, objects that connections join to a scene.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import writing
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering.looks import TubeMesh, body_mesh
from kinefit.exporters.skeletons import common

TICKS_PER_S = 46_186_158_000
"""Unit of time of FBX, KTime, in a second."""

_VERSION = 7500
_CREATED = "1970-01-01 10:00:00:000"  # readers check that the next two belong to this time
_FILE_ID = bytes.fromhex("28b32aebb624ccc2bfc8b02aa92bfcf1")
_FOOT_ID = bytes.fromhex("fabcab09d0c8d466b176fb831cf7267e")
_FOOT_END = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")
_UPS = {"y": (1, 1, 2, 1), "z": (2, 1, 1, -1)}  # vertical axis, its sign, the axis to the viewer, its sign
_TIME_MODES = {120: 1, 100: 2, 60: 3, 50: 4, 48: 5, 30: 6, 25: 10, 24: 11, 1000: 12, 96: 15, 72: 16}  # of a rate [Hz]
_TIME_MODE_CUSTOM = 14
_LINEAR_KEY = 4  # flag of a key: straight to the next one
_DEFAULT_TANGENT = np.array([0, 0, 0x0D050D05, 0], np.uint32).view(np.float32)  # slopes 0, weights of a third
_DEFLATE_LEVEL = 6  # level 9 takes three times as long for 1 % less


@checked
def write_fbx(
    motion: Motion, path: str | PathLike[str], *, unit: str = "cm", up: str = "y", names: str = "kinefit",
    rest: str | None = None, cylinders: bool = False,
) -> None:
    """Write a motion as binary FBX 7.5: a skeleton with its animation, and a mesh that follows it, as of `write_glb`.

    The file states its unit, its vertical axis and its rate. Each frame is a key, the first at time 0. In the bind
    pose, which is the rest pose, the figure stands on the ground, upright.

    Parameters
    ----------
    motion : Motion
    path : path
    unit : "cm", "m" or "mm"
        Unreal takes any unit for centimetres unless it is asked to convert.
    up : "y" or "z"
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Names of the joints.
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with the
        names of Mixamo, VRM, Unity and Unreal.
    cylinders : bool
        The body's cylinders in place of a skin.

    Raises
    ------
    ExportError
        A motion without frames, unknown unit, axis, names or rest pose, or the file cannot be written.
    """
    common.check_frames(motion, path)
    body, factor = motion.body, common.length_factor(unit, common.UNITS, path)
    world = common.turned(motion, up, path, _UPS)
    joints, pose = common.bone_names(body, names, path), common.rest_pose(body, rest, names, path)
    mesh = pose.posed(body_mesh(body, cylinders=cylinders), body)
    pose, mesh = _on_the_ground(pose, mesh)
    scene = _Scene(*pose.matrices(up, factor), factor)
    bones = _add_bones(scene, body, joints)
    figure = common.plain_names([*joints, body.name])[-1]
    _add_bind_pose(scene, bones, _add_skin(scene, figure, mesh, dict(zip(joints, bones))))
    ticks = np.rint((world.times - world.times[0]) * TICKS_PER_S).astype(np.int64)
    clip = common.plain_names([motion.name])[0]
    _add_animation(scene, clip, world, pose, bones, ticks)
    records = [*_head(), _settings(motion.rate, ticks, up, factor), *scene.records(clip, ticks)]
    with writing(path) as temporary, temporary.open("wb") as file:
        file.writelines(_file(records))


@dataclass(frozen=True)
class Record:
    """A node of an FBX file: its name, properties as bytes, nodes inside."""

    name: str
    properties: tuple[bytes, ...]
    inside: tuple[Record, ...]

    @property
    def closed(self) -> bool:
        """Whether an empty record ends it."""
        return bool(self.inside or not self.properties or self.name in ("AnimationStack", "AnimationLayer"))

    def size(self) -> int:
        """Bytes of it in a file."""
        own = _HEAD.size + len(self.name) + sum(map(len, self.properties))
        return own + sum(record.size() for record in self.inside) + len(_EMPTY) * self.closed

    def pieces(self, start: int) -> Iterator[bytes]:
        """Its bytes, from a place in the file on."""
        length = sum(map(len, self.properties))
        name = self.name.encode()
        yield _HEAD.pack(start + self.size(), len(self.properties), length, len(name)) + name
        yield from self.properties
        start += _HEAD.size + len(name) + length
        for record in self.inside:
            yield from record.pieces(start)
            start += record.size()
        if self.closed:
            yield _EMPTY


_HEAD = struct.Struct("<QQQB")  # end in the file, number of properties, their bytes, bytes of the name
_EMPTY = bytes(_HEAD.size)


def record(name: str, *values: Any, inside: Iterable[Record] = ()) -> Record:
    """A node with values: bool, int (32 bits), numpy's integer (64 bits), float, text, bytes, array (N,) or encoded."""
    return Record(name, tuple(map(_encoded, values)), tuple(inside))


class _Encoded(bytes):
    """A property as it stands in the file."""


def _encoded(value: Any) -> bytes:
    match value:
        case _Encoded():
            return value
        case bool():
            return b"C" + struct.pack("<?", value)
        case np.integer():
            return b"L" + struct.pack("<q", value)
        case int():
            return b"I" + struct.pack("<i", value)
        case float():
            return b"D" + struct.pack("<d", value)
        case str() | bytes():
            data = value if isinstance(value, bytes) else value.encode()
            return (b"S" if isinstance(value, str) else b"R") + struct.pack("<I", len(data)) + data
    code = {"float64": b"d", "float32": b"f", "int64": b"l", "int32": b"i"}[value.dtype.name]
    data = zlib.compress(value.tobytes(), _DEFLATE_LEVEL)
    return code + struct.pack("<III", value.size, 1, len(data)) + data


def _table(*rows: Sequence[Any]) -> Record:
    """Named values of an object: (name, type, label, flags, values ...)."""
    return record("Properties70", inside=[record("P", *row) for row in rows])


def _time(name: str, value: np.int64) -> tuple[Any, ...]:
    return name, "KTime", "Time", "", value


def _file(records: Sequence[Record]) -> Iterator[bytes]:
    """All bytes of a file."""
    head = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", _VERSION)
    yield head
    place = len(head)
    for each in records:
        yield from each.pieces(place)
        place += each.size()
    yield _EMPTY + _FOOT_ID + bytes(4)
    place += len(_EMPTY) + len(_FOOT_ID) + 4
    yield bytes(16 - place % 16) + struct.pack("<I", _VERSION) + bytes(120) + _FOOT_END


def _head() -> Iterator[Record]:
    stamp = [record(name, value) for name, value in (
        ("Version", 1000), ("Year", 1970), ("Month", 1), ("Day", 1), ("Hour", 10), ("Minute", 0), ("Second", 0),
        ("Millisecond", 0),
    )]  # fmt: skip
    yield record("FBXHeaderExtension", inside=[
        record("FBXHeaderVersion", 1003), record("FBXVersion", _VERSION), record("EncryptionType", 0),
        record("CreationTimeStamp", inside=stamp), record("Creator", "kinefit"),
    ])  # fmt: skip
    yield from (record("FileId", _FILE_ID), record("CreationTime", _CREATED), record("Creator", "kinefit"))


def _settings(rate: float, ticks: NDArray, up: str, factor: float) -> Record:
    """Axes, unit (in centimetres) and rate of the file."""
    axes = zip(("UpAxis", "UpAxisSign", "FrontAxis", "FrontAxisSign", "CoordAxis", "CoordAxisSign"), (*_UPS[up], 0, 1))
    mode = _TIME_MODES.get(round(rate), _TIME_MODE_CUSTOM) if rate == round(rate) else _TIME_MODE_CUSTOM
    return record("GlobalSettings", inside=[record("Version", 1000), _table(
        *((name, "int", "Integer", "", value) for name, value in axes),
        ("UnitScaleFactor", "double", "Number", "", common.UNITS["cm"] / factor), ("TimeMode", "enum", "", "", mode),
        _time("TimeSpanStart", ticks[0]), _time("TimeSpanStop", ticks[-1]),
        ("CustomFrameRate", "double", "Number", "", float(rate)),
    )])  # fmt: skip


class _Scene:
    """Objects of a file and what joins them; of the figure at rest, lengths in the file's unit.

    Parameters
    ----------
    local, bind : (S, 4, 4) poses of bones in their parents and in the world.
    factor : units of length in a metre.
    """

    def __init__(self, local: NDArray, bind: NDArray, factor: float) -> None:
        self.local, self.bind, self.factor = local, bind, factor
        self._objects, self._links = list[Record](), list[Record]()

    def add(self, kind: str, name: str, class_name: str, sub: str, *inside: Record) -> np.int64:
        """Add an object and return its number."""
        number = np.int64(1 + len(self._objects))
        self._objects.append(record(kind, number, f"{name}\0\1{class_name}", sub, inside=inside))
        return number

    def join(self, child: np.int64, parent: np.int64, *place: str) -> None:
        """Put an object below another one, or below a property of it; 0 is the scene."""
        self._links.append(record("C", "OP" if place else "OO", child, parent, *place))

    def records(self, clip: str, ticks: NDArray) -> Iterator[Record]:
        """Nodes of the file from the documents on, with a clip of this name."""
        document = _table(("ActiveAnimStackName", "KString", "", "", clip))
        number = np.int64(1 + len(self._objects))
        yield record("Documents", inside=[record("Count", 1), record(
            "Document", number, "Scene", "Scene", inside=[document, record("RootNode", np.int64(0))],
        )])  # fmt: skip
        yield record("References")
        kinds = [each.name for each in self._objects]
        counts = {"GlobalSettings": 1, **{kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}}
        yield record("Definitions", inside=[
            record("Version", 100), record("Count", sum(counts.values())),
            *(record("ObjectType", kind, inside=[record("Count", count)]) for kind, count in counts.items()),
        ])  # fmt: skip
        yield record("Objects", inside=self._objects)
        yield record("Connections", inside=self._links)
        span = [record(name, ticks[0], ticks[-1]) for name in ("LocalTime", "ReferenceTime")]
        take = record("Take", clip, inside=[record("FileName", f"{clip}.tak"), *span])
        yield record("Takes", inside=[record("Current", clip), take])


def _on_the_ground(pose: common.Rest, mesh: TubeMesh) -> tuple[common.Rest, TubeMesh]:
    """The rest pose and the mesh in it, raised until the lowest point is at 0.

    Programs that transfer a motion divide by the height of the hips at rest, which would be 0.
    """
    raised = np.array([0.0, -np.concatenate([pose.positions, mesh.vertices])[:, 1].min(), 0.0])
    offsets = pose.offsets.copy()
    offsets[0] += raised
    placed = replace(pose, offsets=offsets, positions=pose.positions + raised)
    return placed, replace(mesh, vertices=mesh.vertices + raised)


def _model(*placed: tuple[Any, ...]) -> tuple[Record, ...]:
    """What models have: their place, and that they inherit scales as programs of today do."""
    shown = _table(("RotationActive", "bool", "", "", 1), ("InheritType", "enum", "", "", 1), *placed)
    return record("Version", 232), shown, record("Shading", True), record("Culling", "CullingOff")


def _add_bones(scene: _Scene, body: Body, names: list[str]) -> list[np.int64]:
    """Add a bone for each segment, at rest; their numbers."""
    angles = np.degrees(common.euler(scene.local[None, :, :3, :3], "zyx"))[0, :, ::-1]
    bones = list[np.int64]()
    for s, name in enumerate(names):
        shown = scene.add("NodeAttribute", name, "NodeAttribute", "LimbNode", record("TypeFlags", "Skeleton"))
        bones.append(scene.add("Model", name, "Model", "LimbNode", *_model(
            ("Lcl Translation", "Lcl Translation", "", "A", *scene.local[s, :3, 3].tolist()),
            ("Lcl Rotation", "Lcl Rotation", "", "A", *angles[s].tolist()),
        )))  # fmt: skip
        scene.join(shown, bones[s])
        parent = body.tree.parents[s]
        scene.join(bones[s], bones[parent] if parent >= 0 else np.int64(0))
    return bones


def _add_skin(scene: _Scene, name: str, mesh: TubeMesh, bones: Mapping[str, np.int64]) -> list[np.int64]:
    """Add a mesh that follows bones {name: number}; its number, none of a body without surfaces."""
    if not len(mesh.vertices):
        return []
    R = scene.bind[0, :3, :3]
    corners = mesh.triangles.astype(np.int32)
    last = corners * np.array([1, 1, -1], np.int32) - np.array([0, 0, 1], np.int32)  # of a polygon: -1 - index
    colours, of_faces = np.unique(mesh.colours[corners[:, 0]], axis=0, return_inverse=True)
    layers = [
        _layer("Normal", "ByPolygonVertex", "Direct", record("Normals", (mesh.normals[corners.ravel()] @ R.T).ravel())),
        _layer("Material", "ByPolygon", "IndexToDirect", record("Materials", of_faces.ravel().astype(np.int32))),
    ]
    listed = [record("LayerElement", inside=[record("Type", each.name), record("TypedIndex", 0)]) for each in layers]
    shape = scene.add(
        "Geometry", "surface", "Geometry", "Mesh",
        record("Vertices", (scene.factor * mesh.vertices @ R.T).ravel()), record("PolygonVertexIndex", last.ravel()),
        record("GeometryVersion", 124), *layers, record("Layer", 0, inside=[record("Version", 100), *listed]),
    )  # fmt: skip
    model = scene.add("Model", name, "Model", "Mesh", *_model())
    skin = scene.add("Deformer", "skin", "Deformer", "Skin", record("Version", 101), record("Link_DeformAcuracy", 50.0))
    for child, parent in ((model, np.int64(0)), (shape, model), (skin, shape)):
        scene.join(child, parent)
    for colour, linear in zip(colours, common.linear_colours(colours).tolist()):
        look = scene.add(
            "Material", f"skin_{colour.tobytes().hex()}", "Material", "", record("Version", 102),
            record("ShadingModel", "lambert"), _table(("DiffuseColor", "Color", "", "A", *linear)),
        )  # fmt: skip
        scene.join(look, model)
    for s, (bone_name, bone) in enumerate(bones.items()):
        weights = np.where(mesh.segments == s, mesh.weights, 0.0).sum(axis=1)
        followers = np.flatnonzero(weights)
        if len(followers):
            cluster = scene.add(
                "Deformer", bone_name, "SubDeformer", "Cluster", record("Version", 100), record("UserData", "", ""),
                record("Indexes", followers.astype(np.int32)), record("Weights", weights[followers]),
                record("Transform", _by_columns(np.linalg.inv(scene.bind[s]))),
                record("TransformLink", _by_columns(scene.bind[s])),
            )  # fmt: skip
            scene.join(cluster, skin)
            scene.join(bone, cluster)
    return [model]


def _layer(kind: str, mapping: str, reference: str, values: Record) -> Record:
    """A layer of a mesh: values of corners or faces, or indices of them."""
    return record(f"LayerElement{kind}", 0, inside=[
        record("Version", 101), record("Name", ""), record("MappingInformationType", mapping),
        record("ReferenceInformationType", reference), values,
    ])  # fmt: skip


def _by_columns(T: NDArray) -> NDArray:
    """(16,) a matrix (4, 4), column after column."""
    return T.T.ravel()


def _add_bind_pose(scene: _Scene, bones: list[np.int64], meshes: list[np.int64]) -> None:
    placed = [*zip(bones, scene.bind), *((mesh, np.eye(4)) for mesh in meshes)]
    nodes = [record("PoseNode", inside=[record("Node", n), record("Matrix", _by_columns(T))]) for n, T in placed]
    head = [record("Type", "BindPose"), record("Version", 100), record("NbPoseNodes", len(nodes))]
    scene.add("Pose", "rest", "Pose", "BindPose", *head, *nodes)


def _add_animation(
    scene: _Scene, clip: str, motion: Motion, pose: common.Rest, bones: list[np.int64], ticks: NDArray
) -> None:
    """Add keys of every frame: the root turns and moves, other joints as they can."""
    span = [(f"{of}{end}", at) for of in ("Local", "Reference") for end, at in zip(("Start", "Stop"), ticks[[0, -1]])]
    stack = scene.add("AnimationStack", clip, "AnimStack", "", _table(*(_time(name, at) for name, at in span)))
    layer = scene.add("AnimationLayer", clip, "AnimLayer", "")
    scene.join(layer, stack)
    angles, places = _local_courses(motion, pose, scene.factor)
    times = _Encoded(_encoded(ticks))
    turning, moving = common.turning_segments(motion.body), common.moving_segments(motion.body)
    for s, bone in enumerate(bones):
        for letter, name, values in (("R", "Lcl Rotation", angles), ("T", "Lcl Translation", places)):
            if (turning if letter == "R" else moving)[s]:
                axes = [(f"d|{axis}", float(start)) for axis, start in zip("XYZ", values[0, s])]
                rows = [(axis, "Number", "", "A", start) for axis, start in axes]
                node = scene.add("AnimationCurveNode", letter, "AnimCurveNode", "", _table(*rows))
                scene.join(node, layer)
                scene.join(node, bone, name)
                for a, (axis, start) in enumerate(axes):
                    scene.join(_add_curve(scene, times, start, values[:, s, a]), node, axis)


def _local_courses(motion: Motion, pose: common.Rest, factor: float) -> tuple[NDArray, NDArray]:
    """Angles (F, S, 3) [deg] about x, y, z, of which x turns first, and places (F, S, 3) of bones in their parents."""
    turns, places = list[NDArray](), list[NDArray]()
    for part in motion.parts():
        Ts = pose.local_poses(part)
        turns.append(common.euler(Ts[..., :3, :3], "zyx", turns[-1][-1] if turns else None))
        places.append(factor * Ts[..., :3, 3])
    return np.degrees(np.concatenate(turns))[..., ::-1], np.concatenate(places)


def _add_curve(scene: _Scene, times: _Encoded, start: float, values: NDArray) -> np.int64:
    """Add keys at times (F,), straight from each value (F,) to the next."""
    return scene.add(
        "AnimationCurve", "", "AnimCurve", "", record("Default", start), record("KeyVer", 4009),
        record("KeyTime", times), record("KeyValueFloat", values.astype(np.float32)),
        record("KeyAttrFlags", np.array([_LINEAR_KEY], np.int32)), record("KeyAttrDataFloat", _DEFAULT_TANGENT),
        record("KeyAttrRefCount", np.array([len(values)], np.int32)),
    )  # fmt: skip
