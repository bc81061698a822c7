"""A made-up character as GLB or BVH: its own bone lengths, a rest pose of its own, a box about each bone."""

import json
import struct

import numpy as np

from kinefit.geometry import se3

PARENTS = {
    "Hips": None, "Spine": "Hips", "Spine1": "Spine", "Spine2": "Spine1", "Neck": "Spine2", "Head": "Neck",
    "HeadTop_End": "Head",
    **{name.format(S): parent.format(S) for S in ("Left", "Right") for name, parent in {
        "{}Shoulder": "Spine2", "{}Arm": "{}Shoulder", "{}ForeArm": "{}Arm", "{}Hand": "{}ForeArm",
        "{}HandMiddle1": "{}Hand", "{}UpLeg": "Hips", "{}Leg": "{}UpLeg", "{}Foot": "{}Leg", "{}ToeBase": "{}Foot",
        "{}Toe_End": "{}ToeBase"}.items()},
}  # fmt: skip
SOLE = 0.03  # [m] of the mesh below the toes' joints


def rest(arms=0.0, longer=1.0):
    """[m] places of the joints, y up, facing z, left at +x; arms hang `arms` radians below the horizontal."""
    x = {
        "Hips": (0, 1.0, 0), "Spine": (0, 1.1, -0.01), "Spine1": (0, 1.22, -0.02), "Spine2": (0, 1.36, -0.02),
        "Neck": (0, 1.55, 0), "Head": (0, 1.62, 0.02), "HeadTop_End": (0, 1.82, 0.03),
    }  # fmt: skip
    for side, s in (("Left", 1.0), ("Right", -1.0)):
        along = np.array([s * np.cos(arms), -np.sin(arms), 0.0])
        shoulder = np.array([s * 0.17, 1.5, 0.0])
        x[f"{side}Shoulder"] = np.array([s * 0.05, 1.48, 0.0])
        for name, far in (("Arm", 0.0), ("ForeArm", 0.24 * longer), ("Hand", 0.52 * longer), ("HandMiddle1", 0.62)):
            x[f"{side}{name}"] = shoulder + far * along
        for name, place in {
            "UpLeg": (0.1, 0.95, 0), "Leg": (0.1, 0.55, 0.01), "Foot": (0.1, 0.10, -0.01),
            "ToeBase": (0.115, SOLE, 0.13), "Toe_End": (0.125, SOLE, 0.21),
        }.items():
            x[f"{side}{name}"] = np.array(place) * (s, 1, 1)
    return {name: np.asarray(x[name], float) for name in PARENTS}


DIGITS = {"Thumb": 0.03, "Index": 0.025, "Middle": 0.008, "Ring": -0.01, "Pinky": -0.027}
"""Mixamo's digits, and how far [m] towards the thumb they begin."""


def fingers(bend=0.0, spread=0.0, thumb=0.6, bones=3, digits=tuple(DIGITS), tips=True, arms=0.0, longer=1.0):
    """Name -> (parent, place) of fingers of hands whose palms face down; turns [rad] of each bone, of the outer digits.

    `thumb` is the angle of the thumb from the hand's direction; it points down, too, where it is large.
    """
    out, places = {}, rest(arms, longer)
    for side, s in (("Left", 1.0), ("Right", -1.0)):
        hand, along = places[f"{side}Hand"], np.array([s * np.cos(arms), -np.sin(arms), 0.0])
        front = np.array([0.0, 0.0, 1.0])
        palm = np.cross(along, front) * s
        for digit in digits:
            begin = 0.03 if digit == "Thumb" else 0.09
            across = spread * DIGITS[digit] / 0.025 if digit != "Thumb" else thumb
            parent, place = f"{side}Hand", hand + begin * along + DIGITS[digit] * front
            for bone in range(1, bones + 1 + tips):
                name = f"{side}Hand{digit}{bone if bone <= bones or bones == 3 else '_End'}"
                out[name] = (parent, place)
                parent, turn = name, bend * bone
                ahead = np.cos(across) * along + np.sin(across) * front
                place = place + 0.03 * (np.cos(turn) * ahead + np.sin(turn) * palm)
    return out


def write_character_glb(
    path, *, arms=0.0, longer=1.0, prefix="mixamorig:", seed=0, leave_out=(), unit=0.01, more=None
):
    """Write it; its frames are turned at random, below a node of scale `unit` that is turned, as by Blender.

    `more` joints, as of `fingers`, may replace others.
    """
    rng, more = np.random.default_rng(seed), more or {}
    parents = PARENTS | {name: parent for name, (parent, _) in more.items()}
    places = rest(arms, longer) | {name: place for name, (_, place) in more.items()}
    names = [name for name in parents if name not in leave_out]
    top = np.eye(4)
    top[:3, :3] = unit * se3.exp_so3(np.array([-np.pi / 2, 0, 0]))
    world = {name: se3.transform(se3.exp_so3(rng.normal(0, 1, 3)), places[name]) for name in names}
    for T in world.values():
        T[:3, :3] *= unit
    nodes, number = [], {name: k + 1 for k, name in enumerate(names)}
    quaternion = np.roll(se3.quaternion(top[:3, :3] / unit), -1)
    nodes.append({"name": "Armature", "rotation": quaternion.tolist(), "scale": [unit] * 3})
    nodes[0]["children"] = [1, len(names) + 1]
    for name in names:
        local = np.linalg.inv(world[parents[name]] if parents[name] else top) @ world[name]
        node = {"name": prefix + name, "children": [number[c] for c in names if parents[c] == name]}
        if name == "Spine":
            node["matrix"] = local.T.ravel().tolist()
        else:
            node["rotation"] = np.roll(se3.quaternion(local[:3, :3]), -1).tolist()
            node["translation"] = local[:3, 3].tolist()
        nodes.append({key: value for key, value in node.items() if value != []})
    nodes.append({"name": "body", "mesh": 0, "skin": 0})
    vertices, owners, faces = [], [], []
    for name in names:
        ends = [c for c in names if parents[c] == name] or [name]
        thick = 0.2 * SOLE if name in more else SOLE
        low = np.min([places[name], *(places[e] for e in ends[:1])], axis=0) - thick
        high = np.max([places[name], *(places[e] for e in ends[:1])], axis=0) + thick
        corners = np.stack(np.meshgrid(*zip(low, high), indexing="ij"), axis=-1).reshape(8, 3)
        box = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
               (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
        faces += [[v + 8 * len(owners) for v in face] for face in box]
        vertices.append(corners)
        owners.append(names.index(name))
    joints = np.zeros((8 * len(owners), 4), np.uint8)
    joints[:, 0] = np.repeat(owners, 8)
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (len(joints), 1))
    bind = np.array([np.linalg.inv(world[name]).T for name in names], np.float32)
    binary, views, accessors = b"", [], []
    for array, kind, component in (
        (np.concatenate(vertices).astype(np.float32), "VEC3", 5126), (joints, "VEC4", 5121), (weights, "VEC4", 5126),
        (np.array(faces, np.uint16).ravel(), "SCALAR", 5123), (bind, "MAT4", 5126),
    ):  # fmt: skip
        content = array.tobytes() + bytes(-array.nbytes % 4)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        binary += content
    first = np.concatenate(vertices).astype(np.float32)
    accessors[0] |= {"min": first.min(0).tolist(), "max": first.max(0).tolist()}
    told = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 3}]}],
        "skins": [{"joints": [number[name] for name in names], "inverseBindMatrices": 4}],
        "buffers": [{"byteLength": len(binary)}], "bufferViews": views, "accessors": accessors,
        "extras": {"made": "up"},
    }  # fmt: skip
    text = json.dumps(told).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def write_character_bvh(path, *, arms=0.0, longer=1.0, unit=0.01, order="YXZ", prefix=""):
    """The same skeleton as BVH, in the rest pose for one frame."""
    places, lines, channels = rest(arms, longer), ["HIERARCHY"], 0

    def joint(name, depth):
        nonlocal channels
        tab, parent = "\t" * depth, PARENTS[name]
        offset = (places[name] - places[parent]) / unit if parent else places[name] * 0
        children = [c for c in PARENTS if PARENTS[c] == name]
        if not children:
            lines.extend([f"{tab}End Site", f"{tab}{{", f"{tab}\tOFFSET {' '.join(map(str, offset))}", f"{tab}}}"])
            return
        turns = " ".join(f"{axis}rotation" for axis in order)
        told = f"6 Xposition Yposition Zposition {turns}" if parent is None else f"3 {turns}"
        channels += int(told[0])
        lines.extend([f"{tab}{'JOINT' if parent else 'ROOT'} {prefix}{name}", f"{tab}{{"])
        lines.extend([f"{tab}\tOFFSET {' '.join(map(str, offset))}", f"{tab}\tCHANNELS {told}"])
        for child in children:
            joint(child, depth + 1)
        lines.append(f"{tab}}}")

    joint("Hips", 0)
    start = " ".join(map(str, [*(places["Hips"] / unit), *[0.0] * (channels - 3)]))
    path.write_text("\n".join([*lines, "MOTION", "Frames: 1", "Frame Time: 0.0166667", start, ""]))
