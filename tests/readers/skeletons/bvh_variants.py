"""Write one motion as BVH with other joint frames, rest poses, channels and vertical axes: joint positions agree."""

import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kinefit.observations import SkeletonMotion


def turned(motion: SkeletonMotion, *degrees: float) -> NDArray:
    """(J, 3, 3) joint frames of a rest pose turned as a whole by angles about x, y, z."""
    return np.tile(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), (len(motion.names), 1, 1))


def any_frames(motion: SkeletonMotion, seed: int = 0) -> NDArray:
    """(J, 3, 3) joint frames that nothing connects: the rest pose is no pose of a person."""
    return Rotation.random(len(motion.names), random_state=seed).as_matrix()


def along(motion: SkeletonMotion, axis: int = 0) -> NDArray:
    """(J, 3, 3) joint frames with one axis along the bone: the rest pose is a line."""
    out = np.tile(np.eye(3), (len(motion.names), 1, 1))
    for j in range(len(out)):
        bones = [v for v in motion.offsets[motion.parents == j] if np.linalg.norm(v) > 1e-6]
        if bones:
            out[j] = Rotation.align_vectors([bones[-1]], [np.eye(3)[axis]])[0].as_matrix()
    return out


def write_variant(motion: SkeletonMotion, path, frames: NDArray, *, offsets=True, rotations=True, world=None, unit=1.0):
    """Write a BVH.

    Parameters
    ----------
    frames : (J, 3, 3) rotation of every joint's new frame in its frame of `motion`, which is aligned at rest.
    offsets : False writes OFFSETs of zero, and positions in the channels of all joints.
    rotations : False writes positions alone.
    world : (3, 3) from the motion's world to the file's.
    unit : metres per unit of the file.
    """
    world = np.eye(3) if world is None else world
    x, R = motion.positions @ world.T / unit, world @ motion.Ts_world_joint[..., :3, :3] @ frames
    columns, lines = [], ["HIERARCHY"]

    def write(joint: int, depth: int) -> None:
        parent, tabs = int(motion.parents[joint]), "\t" * depth
        children = np.flatnonzero(motion.parents == joint)
        is_end, is_placed = not len(children), parent < 0 or not offsets or not rotations
        kind = "End Site" if is_end else f"{'JOINT' if parent >= 0 else 'ROOT'} {motion.names[joint]}"
        offset = frames[parent].T @ motion.offsets[joint] / unit if parent >= 0 and (offsets or is_end) else np.zeros(3)
        lines.extend([f"{tabs}{kind}", f"{tabs}{{", f"{tabs}\tOFFSET {' '.join(f'{v:.6f}' for v in offset)}"])
        if not is_end:
            names = [f"{a}position" for a in "XYZ" if is_placed] + [f"{a}rotation" for a in "ZYX" if rotations]
            lines.append(f"{tabs}\tCHANNELS {len(names)} {' '.join(names)}")
            turn = np.swapaxes(R[:, parent], 1, 2) @ R[:, joint] if parent >= 0 else R[:, joint]
            away = x[:, joint] - x[:, parent] if parent >= 0 else x[:, joint]
            if is_placed:
                columns.append(np.einsum("fji,fj->fi", R[:, parent], away) if parent >= 0 and rotations else away)
            if rotations:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # where axes meet, one of many right solutions will do
                    columns.append(Rotation.from_matrix(turn).as_euler("ZYX", degrees=True))
        for child in children:
            write(int(child), depth + 1)
        lines.append(f"{tabs}}}")

    write(0, 0)
    lines += ["MOTION", f"Frames: {len(x)}", f"Frame Time: {1 / motion.rate:.9f}"]
    lines += [" ".join(f"{v:.6f}" for v in row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n")
    return path
