"""A motion on the skeleton of another character: its bones point where the body's do, its feet keep to the ground.

Where both stand upright their trunks, heads and feet agree; of arms and legs the bones' directions agree, however the
character rests (T, A, arms hanging), and so do those of fingers. Every joint turns by D = R_segment Cᵀ from its rest, C
the segment's axes at rest.
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_bytes, write_lines
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion, continuous_quaternions
from kinefit.bodies.toml.joint_names import DIGITS, FINGERS, SIDES, humanoid_segments, joint_map
from kinefit.errors import BodyError, ExportError, FileError
from kinefit.exporters.skeletons.bvh import bvh_motion
from kinefit.exporters.skeletons.common import euler
from kinefit.exporters.skeletons.glb import GltfFile
from kinefit.geometry import se3
from kinefit.readers.skeletons.characters import KINDS, Character, read_character

# Bones whose direction is kept, with the segment that each leads to.
_NEXT_SEGMENT = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
_BODY_NEEDED = tuple(f"{name}_{side}" for name in ("thigh", "shank", "upperarm", "forearm") for side in "lr")
_UP = np.array([0.0, 1.0, 0.0])
_ALONG = 0.9  # cosine above which a bone that points forward tells nothing of what is in front of it
_LIKE_KNUCKLES = (("index",), ("pinky", "little"))  # in names of bones that no convention knows
_STANCE = 0.01  # [m] a foot so much lower than the other carries most of the weight; a swinging one clears some cm
_LOWEST = 5.0  # percentile of the lowest point's height that counts as the ground


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A motion of a character's nodes.

    Parameters
    ----------
    character : Character
    rotations : (F, J, 3, 3) of every node in its parent.
    moving : (J,) bool, nodes that turn against their parent; all others rest.
    mover : int, the node that moves.
    places : (F, 3) of the mover in its parent, in the file's unit.
    positions : (F, J, 3) [m] of all nodes, y up.
    segments : node -> segment of the body whose turn it does.
    lacking : segments of the body's fingers for which the character has no bone.
    """

    character: Character
    rotations: NDArray
    moving: NDArray
    mover: int
    places: NDArray
    positions: NDArray
    segments: Mapping[int, str]
    lacking: tuple[str, ...] = ()


def retargeted(motion: Motion, character: Character, names: Mapping[str, str] | None = None) -> Retargeted:
    """Put a motion onto a character.

    Parameters
    ----------
    motion : Motion
        Of a person: arms and legs are needed.
    character : Character
    names : segment -> name of the character's joint, optional
        Goes before what the names tell (`bodies.joint_names`).

    Raises
    ------
    BodyError
        The character lacks joints, or the body does; they are named.
    ExportError
        No frames; a character that does not stand at rest, or whose sides are exchanged.
    """
    if not len(motion):
        raise ExportError("a motion without frames cannot be put onto a character", file=character.path)
    nodes, motion = _nodes(character, names), motion.turned("y")
    segments = _segments(motion.body)
    used = {segment: node for segment, node in nodes.items() if segment in segments}
    poses = motion.segment_poses()
    axes = _axes(character, nodes, motion.body, segments, used)
    add_finger_axes(axes, character, used, motion.body)
    turns = {used[name]: poses[:, segments[name], :3, :3] @ C.T for name, C in axes.items()}
    mover = _common(character, list(nodes.values()))
    turns[mover] = turns[nodes["pelvis"]]
    _between(character, nodes, used, turns)
    D = np.tile(np.eye(3), (len(motion), len(character.names), 1, 1))
    places = np.tile(character.positions, (len(motion), 1, 1))
    for node in character.order:
        parent = character.parents[node]
        if parent >= 0:
            D[:, node] = D[:, parent]
            step = character.positions[node] - character.positions[parent]
            places[:, node] = places[:, parent] + D[:, parent] @ step
        D[:, node] = turns.get(int(node), D[:, node])
    below = _below(character, mover)
    places[:, below] += _root(motion, poses, segments, character, nodes, D, places)[:, None]
    frames = D @ character.rotations
    parents = character.parents
    above = np.where((parents >= 0)[:, None, None], frames[:, parents], character.world)
    moving = np.zeros(len(parents), bool)
    moving[list(turns)] = True
    return Retargeted(
        character, above.swapaxes(-1, -2) @ frames, moving, mover, character.in_parent(mover, places[:, mover]), places,
        {used[segment]: segment for segment in axes}, tuple(s for s in FINGERS if s in segments and s not in axes),
    )


def _nodes(character: Character, names: Mapping[str, str] | None) -> dict[str, int]:
    """Segment -> node of a character that stands, its left to the left; the thorax carries arms and head."""
    there = np.flatnonzero(character.joints)
    mapped = {segment: character.names[node] for segment, node in character.vrm_joints.items()}
    found = joint_map([character.names[n] for n in there], {**mapped, **(names or {})}, source=str(character.path))
    nodes = {segment: int(there[i]) for segment, i in found.items()}
    hands = {side: _below(character, nodes[f"hand_{side}"]) for side in "lr"}
    nodes = {segment: node for segment, node in nodes.items() if segment not in FINGERS or node in hands[segment[-1]]}
    carrier = _common(character, [nodes["upperarm_l"], nodes["upperarm_r"], nodes["head"]])
    if carrier != nodes["pelvis"] and "thorax" not in (names or {}):
        nodes = {segment: node for segment, node in nodes.items() if node != carrier} | {"thorax": carrier}
    x, path = character.positions, character.path
    height = x[nodes["head"], 1] - 0.5 * (x[nodes["foot_l"], 1] + x[nodes["foot_r"], 1])
    if height < 0.5 * np.ptp(x[list(nodes.values()), 1]) or height <= 0:
        raise ExportError("the character does not stand upright at rest", file=path, remedy="Save it in a T or A pose.")
    forward = _standing(character, nodes)[:, 0]
    toes = [(x[nodes[f"toes_{s}"]] - x[nodes[f"foot_{s}"]]) @ forward for s in "lr" if f"toes_{s}" in nodes]
    if toes and max(toes) < 0:
        remedy = "Swap them in the table of names."
        raise ExportError("the toes point backwards: left and right are swapped", file=path, remedy=remedy)
    return nodes


def _segments(body: Body) -> dict[str, int]:
    """Segment as the humanoid's are called -> index in a body, by its own names or by those that it gives for BVH."""
    out = {name: number for number, name in enumerate(humanoid_segments(body).values())}
    out |= {name: number for number, name in enumerate(body.tree.segments)}
    lost = [name for name in ("pelvis", *_BODY_NEEDED) if name not in out]
    if lost:
        remedy = "A character takes the motion of a body with arms and legs, such as the humanoid."
        raise BodyError(f"body '{body.name}' has no {', '.join(lost)}", remedy=remedy)
    return out


def _standing(character: Character, nodes: Mapping[str, int]) -> NDArray:
    """(3, 3) columns forward, up and right of the character at rest."""
    across = character.positions[nodes["thigh_r"]] - character.positions[nodes["thigh_l"]]
    right = _unit(across * (1.0, 0.0, 1.0))
    return np.stack([np.cross(_UP, right), _UP, right], axis=1)


def _axes(
    character: Character, nodes: Mapping[str, int], body: Body, segments: Mapping[str, int], used: Mapping[str, int]
) -> dict[str, NDArray]:
    """Segment -> C (3, 3), the axes of the body's segment in the character's world at rest."""
    x, stand = character.positions, _standing(character, nodes)
    forward, out = stand[:, 0], {}
    for segment in used:
        bone, _, side = segment.rpartition("_")
        if segment in FINGERS:
            continue
        if bone == "foot" and f"toes_{side}" in nodes and f"toes_{side}" in segments:
            mine = (x[nodes[f"toes_{side}"]] - x[nodes[segment]]) * (1.0, 0.0, 1.0)
            own = body.tree.offsets[segments[f"toes_{side}"]] * (1.0, 0.0, 1.0)
            out[segment] = _frame(_UP, mine) @ _frame(_UP, own).T
        elif bone == "toes" and f"foot_{side}" in out:
            out[segment] = out[f"foot_{side}"]
        elif bone in _NEXT_SEGMENT or bone == "hand":
            far = _NEXT_SEGMENT.get(bone)
            knuckles = common_knuckles(used, side)
            mine = x[nodes[f"{far}_{side}"]] - x[nodes[segment]] if far else _hand(character, nodes, side)
            ends = [segments[name] for name in ([f"{far}_{side}"] if far else knuckles) if name in segments]
            own = body.tree.offsets[ends].mean(axis=0) if ends else np.array([0.0, -1.0, 0.0])
            front, own_front = forward if abs(_unit(mine) @ forward) < _ALONG else _UP, np.array([1.0, 0.0, 0.0])
            if bone in ("forearm", "hand"):  # thumbs are in front in T and A, outside where palms face forward
                front, own_front = _thumb(character, nodes, side, front), np.array([0, 0, 1.0 if side == "r" else -1.0])
                if len(knuckles) > 1:
                    first, last = (body.tree.offsets[segments[name]] for name in (knuckles[0], knuckles[-1]))
                    own_front = first - last
            out[segment] = _frame(mine, front) @ _frame(own, own_front).T
        else:
            out[segment] = stand
    return out


def _hand(character: Character, nodes: Mapping[str, int], side: str) -> NDArray:
    """Direction of a hand at rest: to its knuckles, or as the forearm where it has none."""
    x, hand = character.positions, nodes[f"hand_{side}"]
    knuckles = [nodes[name] for name in common_knuckles(nodes, side)] or np.flatnonzero(character.parents == hand)
    along = x[hand] - x[nodes[f"forearm_{side}"]]
    to = x[knuckles].mean(axis=0) - x[hand] if len(knuckles) else along
    return to if _unit(to) @ _unit(along) > 0.5 else along


def _thumb(character: Character, nodes: Mapping[str, int], side: str, front: NDArray) -> NDArray:
    """Direction towards the thumb at rest: from the last to the first knuckle where they are named, else the front."""
    x, below = character.positions, _below(character, nodes[f"hand_{side}"])
    ends = [x[nodes[name]] for name in common_knuckles(nodes, side)]
    if len(ends) < 2:
        words = [[n for n in below if any(w in character.names[n].lower() for w in ws)] for ws in _LIKE_KNUCKLES]
        ends = [x[found[0]] for found in words if found]
    return ends[0] - ends[-1] if len(ends) > 1 and np.linalg.norm(ends[0] - ends[-1]) > 1e-4 else front


def _between(
    character: Character, nodes: Mapping[str, int], used: Mapping[str, int], turns: dict[int, NDArray]
) -> None:
    """Give joints of spine and neck between two that turn a share of the turn, each an equal one."""
    trunk = [used[segment] for segment in ("pelvis", "abdomen", "thorax", "head") if segment in used]
    for low, high in pairwise(trunk):
        chain, node = [], int(character.parents[high])
        while node >= 0 and node != low:
            chain.append(node)
            node = int(character.parents[node])
        if node == low and not set(chain) & set(turns):
            step = se3.log_so3(turns[high] @ turns[low].swapaxes(-1, -2))
            for k, joint in enumerate(reversed(chain), 1):
                turns[joint] = se3.exp_so3(step * (k / (len(chain) + 1))) @ turns[low]


def _root(
    motion: Motion, poses: NDArray, segments: Mapping[str, int], character: Character, nodes: Mapping[str, int],
    D: NDArray, places: NDArray,
) -> NDArray:  # fmt: skip
    """(F, 3) [m] shift of a character whose mover rests: its feet go the way of the body's, longer by its legs."""
    tree, x, points = motion.body.tree, character.positions, motion.body.landmarks
    feet, own_low, own, mine = [], [], 0.0, 0.0
    ends = motion.body.segment_ends()
    for side in "lr":
        leg = x[[nodes[f"{bone}_{side}"] for bone in ("thigh", "shank", "foot")]]
        mine += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        shank, foot = segments[f"shank_{side}"], segments.get(f"foot_{side}")
        ankle = tree.offsets[foot] if foot is not None else ends[shank]
        own += float(np.linalg.norm(tree.offsets[shank]) + np.linalg.norm(ankle))
        feet.append(se3.apply(poses[:, shank], ankle))
        parts = [segments[name] for name in (f"foot_{side}", f"toes_{side}") if name in segments]
        sole = points.select(tuple(name for name, s in zip(points.names, points.segments) if s in parts))
        heights = motion.positions(sole)[..., 1] if len(sole) else feet[-1][:, None, 1]
        own_low.append(heights.min(axis=1))
    scale = mine / own
    low = np.min(own_low, axis=0)
    ground = float(np.percentile(low, _LOWEST))
    weight = 1.0 / (1.0 + np.exp(np.clip((own_low[0] - own_low[1]) / _STANCE, -50, 50)))[:, None]  # of the left foot
    target = scale * (weight * feet[0] + (1 - weight) * feet[1])
    there = weight * places[:, nodes["foot_l"]] + (1 - weight) * places[:, nodes["foot_r"]]
    shift = target - there
    shift[:, 1] = ground + scale * (low - ground) - _lowest(character, nodes, D, places)
    return shift


def _lowest(character: Character, nodes: Mapping[str, int], D: NDArray, places: NDArray) -> NDArray:
    """(F,) [m] height of the lowest point of the soles; without a mesh of them, of the joints of the feet."""
    out = []
    for side in "lr":
        below = _below(character, nodes[f"foot_{side}"])
        floor, soles = character.positions[below, 1].min(), np.isin(character.owners, below).any()
        for node in below:
            points = character.points[character.owners == node]
            if not soles:  # below each joint, at the height of the lowest
                points = character.positions[[node]] * (1.0, 0.0, 1.0) + (0.0, floor, 0.0)
            if len(points):
                away = _hull(points) - character.positions[node]
                out.append((places[:, node, 1, None] + D[:, node, 1] @ away.T).min(axis=1))
    return np.min(out, axis=0)


def _hull(points: NDArray) -> NDArray:
    """The points that are farthest in some of many directions: those that may touch the ground."""
    golden = np.arange(256) * np.pi * (3.0 - np.sqrt(5.0))
    height = 1.0 - 2.0 * (np.arange(256) + 0.5) / 256
    around = np.sqrt(1.0 - height**2)
    directions = np.stack([around * np.cos(golden), height, around * np.sin(golden)])
    return points[np.unique(np.argmax(points @ directions, axis=0))]


def _below(character: Character, node: int) -> NDArray:
    """A node and all below it, parents first."""
    inside = np.zeros(len(character.names), bool)
    inside[node] = True
    for other in character.order:
        inside[other] |= character.parents[other] >= 0 and inside[character.parents[other]]
    return character.order[inside[character.order]]


def _common(character: Character, nodes: list[int]) -> int:
    """The lowest node above all of some, or one of them that is above the others."""
    paths = []
    for node in nodes:
        path = [node]
        while character.parents[path[-1]] >= 0:
            path.append(int(character.parents[path[-1]]))
        paths.append(path)
    shared = [node for node in paths[0] if all(node in path for path in paths[1:])]
    if not shared:
        raise FileError("its joints have different roots", file=character.path, remedy="Join them under one node.")
    return shared[0]


def _frame(along: NDArray, beside: NDArray) -> NDArray:
    """(3, 3) columns: the first direction, the second at right angles to it, their cross product."""
    first = _unit(along)
    second = _unit(beside - (first @ beside) * first)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _unit(vector: NDArray) -> NDArray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


_SHORTEST_BONE = 0.001  # [m] a nearer child has no direction


def common_knuckles(nodes: Container[str], side: str) -> list[str]:
    """Segments of a hand's fingers, from index to little finger, that begin at a knuckle and have a bone."""
    names = (f"{digit}_{bones[0]}_{side}" for digit, bones in DIGITS.items() if digit != "thumb")
    return [name for name in names if name in nodes]


def add_finger_axes(axes: dict[str, NDArray], character: Character, used: Mapping[str, int], body: Body) -> None:
    """Add the axes of each finger's segment in the character's world at rest.

    From the hand to the tip, a segment's axes are those of the one above it, turned the shortest way to where the
    character's bone points at rest. So a bone gets the tracked direction whatever its rest pose, and no twist about
    itself that the rest pose does not have.

    Parameters
    ----------
    axes : segment -> (3, 3) columns in the world; those of the hands are there
    character : Character
    used : segment -> node, of all that body and character share
    body : Body
        Its fingers are straight at rest.
    """
    tree = body.tree
    for side in SIDES:
        for digit, bones in DIGITS.items():
            chain = [name for bone in bones if (name := f"{digit}_{bone}_{side}") in used]
            above = f"hand_{side}"
            for name in chain if above in axes else ():
                s = tree.segment(name)
                own = tree.offsets[[*np.flatnonzero(tree.parents == s), s][0]]
                mine = _direction(character, [used[n] for n in (f"hand_{side}", *chain)], used[name])
                axes[name] = se3.shortest_turn(axes[above] @ own, mine) @ axes[above]
                above = name


def in_words(fingers: Sequence[str]) -> str:
    """Segments of fingers by hand: "both hands: ring, little, index distal"; a whole digit by its name alone."""
    hands = {}
    for side, words in SIDES.items():
        missing = []
        for digit, bones in DIGITS.items():
            lost = [bone for bone in bones if f"{digit}_{bone}_{side}" in fingers]
            missing += [digit] if len(lost) == len(bones) else [f"{digit} {bone}" for bone in lost]
        hands[f"{words['side']} hand"] = "all fingers" if missing == list(DIGITS) else ", ".join(missing)
    if len(set(hands.values())) == 1:
        hands = {"both hands": hands["left hand"]}
    return "; ".join(f"{hand}: {missing}" for hand, missing in hands.items() if missing)


def _direction(character: Character, chain: Sequence[int], node: int) -> NDArray:
    """(3,) [m] from a bone of a chain to the next; of the last to its farthest child, or on from the bone above."""
    x, after = character.positions, chain[chain.index(node) + 1 :]
    far = after[:1] or np.flatnonzero(character.parents == node)
    away = x[far] - x[node]
    if len(away) and (lengths := np.linalg.norm(away, axis=1)).max() > _SHORTEST_BONE:
        return np.asarray(away[np.argmax(lengths)])
    return np.asarray(x[node] - x[chain[chain.index(node) - 1]])


@checked
def write_character(
    motion: Motion, character: str | PathLike[str], path: str | PathLike[str], *, names: Mapping[str, str] | None = None
) -> Retargeted:
    """Write a motion on another character: GLB of a GLB, VRM or glTF, BVH of a BVH.

    Of glTF all that the file holds stays, byte for byte; an animation that comes first is added. Of BVH the hierarchy
    stays, and the motion is replaced.

    Parameters
    ----------
    motion : Motion
    character : path
    path : path
        Of the new file, with the ending of its format.
    names : segment -> name of the character's joint, optional

    Returns
    -------
    Retargeted
        What was written.

    Raises
    ------
    FileError
        The character cannot be read.
    BodyError
        It lacks joints, which are named; or the motion's body has no arms or legs.
    ExportError
        No frames, another ending, or the file cannot be written.
    """
    source = read_character(character)
    kind = KINDS[source.path.suffix.lower()]
    fitting = [ending for ending, of in KINDS.items() if of == kind and ending != ".gltf"]
    if Path(path).suffix.lower() not in fitting:
        remedy = f"Name it with {' or '.join(fitting)}."
        raise ExportError(f"a motion on '{source.path.name}' is written as {kind.upper()}", file=path, remedy=remedy)
    found = retargeted(motion, source, names)
    if kind == "glb":
        write_bytes(path, _glb(motion, found))
    else:
        write_lines(path, _bvh(motion, found))
    return found


def _glb(motion: Motion, found: Retargeted) -> bytes:
    assert found.character.gltf is not None
    gltf, nodes = found.character.gltf, map(int, np.flatnonzero(found.moving))
    file = GltfFile(json.loads(json.dumps(gltf.json)), gltf.binary)

    def courses() -> Iterator[tuple[int, str, NDArray]]:
        for node in nodes:
            _as_parts(file.json["nodes"][node], gltf.local(node))
            yield node, "rotation", continuous_quaternions(found.rotations[:, node])
            if node == found.mover:
                yield node, "translation", found.places

    file.animate(motion.name, motion.times, courses())
    return file.packed()


def _as_parts(node: dict[str, Any], M: NDArray) -> None:
    """Replace the matrix of a node that will move by translation, rotation and scale."""
    if node.pop("matrix", None) is None:
        return
    scale = np.linalg.norm(M[:3, :3], axis=0) * np.sign(np.linalg.det(M[:3, :3]))
    w, x, y, z = se3.quaternion(M[:3, :3] / scale)
    node.update(translation=M[:3, 3].tolist(), rotation=[float(v) for v in (x, y, z, w)], scale=scale.tolist())


def _bvh(motion: Motion, found: Retargeted) -> Iterator[str]:
    """Lines of the character's BVH with another motion."""
    character = found.character
    head = re.split(r"^[ \t]*MOTION\b", character.text, maxsplit=1, flags=re.M | re.I)[0]
    lines = re.findall(r"^[ \t]*CHANNELS[ \t]+\d+[ \t]+(.*)$", head, flags=re.M | re.I)
    channels = [words.lower().split() for words in lines]
    joints = [node for node, name in enumerate(character.names) if not name.endswith("_end")]
    if len(channels) != len(joints):
        remedy = "Export the character again, one CHANNELS line for each joint."
        raise ExportError("it has different numbers of joints and CHANNELS lines", file=character.path, remedy=remedy)
    columns: list[NDArray] = []
    for node, names in zip(joints, channels):
        parent = int(character.parents[node])
        rest = character.positions[node] - (character.positions[parent] if parent >= 0 else 0.0)
        turn = character.rotations[parent] if parent >= 0 else character.world
        place = np.tile(rest @ turn / character.unit, (len(motion), 1))
        place = found.places if node == found.mover else place
        axes = "".join(name[0] for name in names if name.endswith("rotation"))
        if len(set(axes)) not in (0, 3):
            problem = f"joint '{character.names[node]}' turns about {len(set(axes))} axes, not three"
            raise ExportError(problem, file=character.path, remedy="Export the character again, for animation.")
        angles = iter(euler(found.rotations[:, node], axes).T if axes else ())
        columns += [
            np.degrees(next(angles)) if name.endswith("rotation") else place[:, "xyz".index(name[0])] for name in names
        ]  # fmt: skip
    yield from head.rstrip().splitlines()
    yield from bvh_motion(motion, [np.stack(columns, axis=1)])
