"""Reading of kinefit's JSON lines, with numpy alone: what Blender brings along."""

import json
from dataclasses import dataclass

import numpy as np

_TO_Z_UP = {  # rows of the rotation from a world with this vertical axis to z up, by the smallest angle
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)), "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)), "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)), "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
BODY_TO_Z_UP = np.array(_TO_Z_UP["y"], float)
"""Bodies rest with y up."""


class LinesError(Exception):
    """A file that is no motion of kinefit."""


@dataclass(frozen=True)
class Lines:
    """A motion.

    Parameters
    ----------
    name, rate : text, [Hz]
    segments : S names; parents : S indices, -1 for the root; offsets : (S, 3) [m] of each joint in its parent
    times : (F,) [s]
    poses : (F, S, 4, 4) [m] of the segments, z up
    std : (F, S) [m] of each joint along the longest axis, inf where nothing observes it
    quality : (F, S) 0 to 1; lost : (F, S) bool
    """

    name: str
    rate: float
    segments: list
    parents: list
    offsets: np.ndarray
    times: np.ndarray
    poses: np.ndarray
    std: np.ndarray
    quality: np.ndarray
    lost: np.ndarray

    @property
    def rest(self):
        """(S, 3) [m] joint centres of the body at rest, z up, its root at the origin."""
        places = np.zeros((len(self.segments), 3))
        for s, parent in enumerate(self.parents):
            places[s] = self.offsets[s] + (places[parent] if parent >= 0 else 0.0)
        return places @ BODY_TO_Z_UP.T


def read_lines(path):
    """A motion of `kinefit export --to jsonl` or `kinefit live --json`; poses after a change of the body alone."""
    hello, poses, number = None, [], 0
    try:
        with open(path, encoding="utf-8") as file:
            for line in file:
                number += 1
                packet = json.loads(line)
                if packet["type"] == "hello":
                    hello, poses = packet, []
                elif packet["type"] == "pose":
                    poses.append(packet)
        if hello is None or hello["format"] != "kinefit live":
            raise LinesError(f"{path} does not begin with a hello of kinefit. Write it by: kinefit export --to jsonl.")
        if not poses:
            raise LinesError(f"{path} holds no pose.")
        places = np.array([p["segments"] for p in poses], float)
        std = np.array([[[np.inf if v is None else v for v in one] for one in p["joint_std"]] for p in poses], float)
        quality = np.array([p["segment_quality"] for p in poses], float)
        lost = np.zeros(quality.shape, bool)
        for f, p in enumerate(poses):
            lost[f, p["lost"]] = True
    except OSError as error:
        raise LinesError(f"{path} cannot be read ({error.strerror}).") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise LinesError(f"{path}, line {number}: this is no motion of kinefit ({error}).") from error
    T = np.tile(np.eye(4), (*places.shape[:2], 1, 1))
    T[..., :3, :3], T[..., :3, 3] = rotations(places[..., 3:]), places[..., :3]
    turn = np.eye(4)
    turn[:3, :3] = _TO_Z_UP[hello["up"]]
    return Lines(
        hello["name"], float(hello["rate"]), hello["segments"], hello["parents"], np.array(hello["offsets"], float),
        np.array([p["time"] for p in poses], float), turn @ T, std.max(axis=-1), quality, lost,
    )


def rotations(q):
    """(..., 3, 3) of quaternions (..., 4) as w, x, y, z."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
