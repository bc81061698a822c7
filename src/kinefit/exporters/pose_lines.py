"""Poses as JSON, one object a line or a message: what `kinefit live` sends and `kinefit export --to jsonl` writes.

Lengths are metres, angles radians, times seconds; rotations are unit quaternions (w, x, y, z); what nothing observes
has the standard deviation null. docs/live.md describes the protocol.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os import PathLike
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import write_lines
from kinefit.bodies import Body
from kinefit.exporters.skeletons.common import turned
from kinefit.geometry import se3
from kinefit.motion import Motion

FORMAT, VERSION = "kinefit live", 1
_DIGITS = 6  # decimals of lengths and angles


def hello(body: Body, *, name: str, rate: float, up: str, sensors: Sequence[str] = ()) -> bytes:
    """What a reader must know before the first pose, and again where the body changes."""
    tree = body.tree
    return msgspec.json.encode({
        "type": "hello", "format": FORMAT, "version": VERSION, "name": name, "rate": rate, "up": up,
        "body": body.name, "segments": list(tree.segments), "parents": tree.parents.tolist(),
        "offsets": _rounded(tree.offsets), "coordinates": list(tree.coordinates),
        "units": ["m" if slides else "rad" for slides in tree.prismatic], "sensors": list(sensors),
    })  # fmt: skip


def pose(
    Ts_world_segment: NDArray, angles: NDArray, dof_std: NDArray, joint_std: NDArray, segment_quality: NDArray, *,
    quality: float, lost: NDArray,
) -> dict[str, Any]:  # fmt: skip
    """What a packet says of one pose.

    Parameters
    ----------
    Ts_world_segment : (S, 4, 4) [m]
    angles : (D,) [rad, m]
    dof_std : (6 + D,), joint_std : (S, 3), inf where nothing observes
    segment_quality : (S,); quality : float
    lost : (S,) bool
    """
    T = Ts_world_segment
    places = np.concatenate([T[:, :3, 3], se3.quaternion(T[:, :3, :3])], axis=1)
    return {
        "segments": _rounded(places), "joint_std": _told(joint_std), "angles": _rounded(angles),
        "root_std": _told(dof_std[:6]), "angle_std": _told(dof_std[6:]), "quality": round(float(quality), 3),
        "segment_quality": np.round(segment_quality, 3).tolist(), "lost": np.flatnonzero(lost).tolist(),
    }  # fmt: skip


def write_jsonl(motion: Motion, path: str | PathLike[str], *, up: str | None = None) -> None:
    """Write a motion as JSON lines: `hello`, then a `pose` for each frame.

    Raises
    ------
    ExportError
        An unknown vertical axis, or the file cannot be written.
    """
    motion = motion if up is None else turned(motion, up, path)
    write_lines(path, _lines(motion))


def _lines(motion: Motion) -> Iterator[str]:
    yield hello(motion.body, name=motion.name, rate=motion.rate, up=motion.up).decode()
    number = 0
    for part in motion.parts():
        poses, lost = part.segment_poses(), part.lost
        for f in range(len(part)):
            entries = pose(
                poses[f], part.angles[f], part.dof_std[f], part.joint_std[f], part.segment_quality[f],
                quality=part.quality[f], lost=lost[f],
            )  # fmt: skip
            packet = {"type": "pose", "number": number, "time": round(float(part.times[f]), 6), **entries}
            yield msgspec.json.encode(packet).decode()
            number += 1


def _rounded(values: NDArray) -> Any:
    return np.round(values, _DIGITS).tolist()


def _told(std: NDArray) -> Any:
    """Standard deviations as JSON has them."""
    finite = np.isfinite(std)
    if finite.all():
        return _rounded(std)
    out = np.round(std, _DIGITS).astype(object)
    out[~finite] = None
    return out.tolist()
