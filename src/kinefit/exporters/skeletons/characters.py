"""A character's own file with a motion in it: mesh, skin and pictures stay as they are."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_bytes, write_lines
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.bvh import bvh_motion
from kinefit.exporters.skeletons.common import euler
from kinefit.exporters.skeletons.glb import GltfFile
from kinefit.exporters.skeletons.retarget import Retargeted, retargeted
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.motion_columns import continuous_quaternions
from kinefit.readers.skeletons.characters import KINDS, read_character


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
    """A node that is to move says its pose in parts, not as a matrix."""
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

