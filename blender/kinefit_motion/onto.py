"""A motion of kinefit onto another armature: its bones point where the person's do.

The armature may rest in any pose: of arms and legs the directions of the bones agree, trunk, head and feet agree where
both stand upright. Every bone turns by D = R_segment Cᵀ from its rest, C the segment's axes on the armature at rest.
"""

import json
import re
from pathlib import Path

import numpy as np

from .figure import frames_of, key

_FAR = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
_NEEDED = tuple(f"{name}_{side}" for name in ("thigh", "shank", "upperarm", "forearm") for side in "lr")
FAMILIES = json.loads((Path(__file__).parent / "names.json").read_text(encoding="utf-8"))
"""Families of names as `kinefit retarget` knows them: segment -> joint."""


class NamesError(Exception):
    """An armature whose bones cannot be told by their names."""


def plain(name):
    """A name without namespace, program's prefix, capitals and separators."""
    last = re.sub(r"(?i)^(mixamorig\d*|bip0*1|def)[ _\-]", "", re.split(r"[:|]", name)[-1])
    return re.sub(r"[\s_.\-]+", "", last).lower()


def bones_of(names, segments):
    """Segment -> bone of an armature, by the family of names that most of its bones bear."""
    there, best = {plain(name): name for name in names}, {}
    for family in FAMILIES:
        found = {s: there[plain(j)] for s, j in family["joints"].items() if plain(j) in there and s in segments}
        best = found if len(found) > len(best) else best
    lost = [name for name in ("pelvis", *_NEEDED) if name not in best]
    if lost:
        raise NamesError(
            f"No bones for {', '.join(lost)}. Names are known of: {', '.join(f['name'] for f in FAMILIES)}; "
            "or give a table of names to kinefit export --retarget."
        )
    return best


def retarget(motion, target, context):
    """Key a motion onto an armature; how many of its bones follow."""
    segments = {name: s for s, name in enumerate(motion.segments)}
    bones = bones_of([b.name for b in target.data.bones], segments)
    world = np.array(target.matrix_world)
    at_rest = {name: np.array(target.data.bones[bone].matrix_local) for name, bone in bones.items()}
    heads = {name: (world @ M)[:3, 3] for name, M in at_rest.items()}
    turn = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0)
    axes = _axes(heads, motion)
    out, scale = {}, _legs(heads) / _legs(dict(zip(motion.segments, motion.rest)))
    for name, bone in bones.items():
        D = motion.poses[:, segments[name], :3, :3] @ axes[name].T  # in the world, from rest
        M = np.tile(np.eye(4), (len(D), 1, 1))
        M[:, :3, :3] = turn.T @ D @ turn @ at_rest[name][:3, :3]
        M[:, :3, 3] = at_rest[name][:3, 3]
        out[bone] = M
    _places(target, out)
    mover = bones["pelvis"]
    shift = scale * (motion.poses[:, segments["pelvis"], :3, 3])
    low = min(heads[f"foot_{side}"][2] for side in "lr" if f"foot_{side}" in heads) if "foot_l" in heads else 0.0
    floor = scale * np.percentile(motion.poses[:, [segments[f"foot_{s}"] for s in "lr"], 2, 3].min(axis=1), 5)
    place = np.concatenate([shift + (0.0, 0.0, low - floor), np.ones((len(shift), 1))], axis=1)
    moved = (place @ np.linalg.inv(world).T)[:, :3] - out[mover][:, :3, 3]
    for M in out.values():
        M[:, :3, 3] += moved
    key(target, out, frames_of(motion), {mover})
    return len(out)


def _places(target, out):
    """Put every bone where its parent, as it is turned, has it."""
    whole = {}
    for bone in target.data.bones:
        local = np.array(bone.matrix_local)
        if bone.parent is None:
            whole[bone.name] = out.get(bone.name, np.tile(local, (len(next(iter(out.values()))), 1, 1)))
            continue
        own = whole[bone.parent.name] @ np.linalg.inv(np.array(bone.parent.matrix_local)) @ local
        if bone.name in out:
            out[bone.name][:, :3, 3] = own[:, :3, 3]
            own = out[bone.name]
        whole[bone.name] = own


def _axes(heads, motion):
    """Segment -> (3, 3) its axes on the armature at rest: columns x forward, y up, z right of a body at rest."""
    across = (heads["thigh_r"] - heads["thigh_l"]) * (1.0, 1.0, 0.0)
    up, right = np.array((0.0, 0.0, 1.0)), across / np.linalg.norm(across)
    forward = np.cross(up, right)
    stand, out = np.stack([forward, up, right], axis=1), {}
    for name in heads:
        limb, _, side = name.rpartition("_")
        far = f"{_FAR.get(limb)}_{side}"
        along = heads[far] - heads[name] if far in heads else None
        if limb == "hand" and f"forearm_{side}" in heads:
            along = heads[name] - heads[f"forearm_{side}"]
        if along is None:
            out[name] = stand
            continue
        number = motion.segments.index(far) if far in motion.segments else None
        own = np.array((0.0, -1.0, 0.0)) if number is None or limb == "hand" else motion.offsets[number]
        front = forward if abs(along @ forward) < 0.9 * np.linalg.norm(along) else up
        own_front = np.array((1.0, 0.0, 0.0))
        if limb in ("forearm", "hand"):
            own_front = np.array((0.0, 0.0, 1.0 if side == "r" else -1.0))
        out[name] = _frame(along, front) @ _frame(own, own_front).T
    return out


def _frame(along, beside):
    first = along / np.linalg.norm(along)
    second = beside - (first @ beside) * first
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _legs(places):
    return sum(
        np.linalg.norm(np.subtract(places[f"{a}_{s}"], places[f"{b}_{s}"]))
        for s in "lr" for a, b in (("thigh", "shank"), ("shank", "foot")) if f"{b}_{s}" in places
    )
