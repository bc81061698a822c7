"""Open3D: ten rigid point-to-plane ICPs a frame, one a segment, each started from its pose in the last frame.

Run as `python -m benchmarks.peers.open3d_icp FOLDER` with a Python that has open3d. FOLDER holds ``clouds.npz``:
``names`` (Q,) of the sequences; of each ``NAME_points`` (F, N, 3) [m] in the world and ``NAME_truth`` (F, S, 4, 4)
T_world_segment; ``samples``, ``normals`` (M, 3) of the surface in its segments' frames and ``owners`` (M,).

A segment is given the points whose nearest sample on all the body, at the last frame's poses, is one of its own: that
is both more exact and faster than all points within reach of its box. The reach with the least joint error counts.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

REACHES = (0.05, 0.1)  # [m] of a correspondence
WARM = 5  # frames whose time is not counted
_icp = o3d.pipelines.registration


class Segments:
    """Samples of all segments' surfaces, ready to be fitted to."""

    def __init__(self, data: Any) -> None:
        count = data[f"{data['names'][0]}_truth"].shape[1]
        self.samples = [data["samples"][data["owners"] == s] for s in range(count)]
        self.targets = [_cloud(x) for x in self.samples]
        for s, target in enumerate(self.targets):
            target.normals = o3d.utility.Vector3dVector(data["normals"][data["owners"] == s])
        self.owners = np.repeat(np.arange(count), [len(x) for x in self.samples])

    def chosen(self, points: np.ndarray, poses: np.ndarray) -> list[np.ndarray]:
        """Points of each segment, in its frame."""
        everywhere = np.concatenate([x @ T[:3, :3].T + T[:3, 3] for x, T in zip(self.samples, poses)])
        tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(everywhere))
        tree.knn_index()
        nearest = tree.knn_search(o3d.core.Tensor.from_numpy(points), 1)[0].numpy()[:, 0]
        mine = [points[self.owners[nearest] == s] for s in range(len(poses))]
        return [(x - T[:3, 3]) @ T[:3, :3] for x, T in zip(mine, poses)]

    def fitted(self, reach: float, points: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """T_world_segment (S, 4, 4) from those of the last frame; kept where ICP finds nothing."""
        out, plane = np.array(poses), _icp.TransformationEstimationPointToPlane()
        for s, mine in enumerate(self.chosen(points, poses)):
            if len(mine) < 6:  # a rigid body has six degrees of freedom
                continue
            result = _icp.registration_icp(_cloud(mine), self.targets[s], reach, np.eye(4), plane)
            T = np.asarray(result.transformation)
            if result.fitness > 0.0 and np.isfinite(T).all():
                out[s] = poses[s] @ np.linalg.inv(T)
        return out


def _cloud(points: np.ndarray) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def followed(segments: Segments, data: Any, reach: float) -> tuple[Any, Any]:
    """CPU time [ms] of each frame, and the distance [mm] of each joint from its true place, (all frames, S)."""
    ms, error = [], []
    for name in data["names"]:
        points, truth = data[f"{name}_points"], data[f"{name}_truth"]
        poses, spent = truth[0], []
        for frame in range(1, len(points)):
            began = time.process_time()
            poses = segments.fitted(reach, points[frame], poses)
            spent.append(1e3 * (time.process_time() - began))
            error.append(1e3 * np.linalg.norm(poses[:, :3, 3] - truth[frame][:, :3, 3], axis=1))
        ms += spent[WARM:]
    return np.array(ms), np.array(error)


def main(folder: Path) -> None:
    """Print a line of JSON."""
    with np.load(folder / "clouds.npz") as file:
        data = dict(file)
    segments, tried = Segments(data), []
    for reach in REACHES:
        ms, error = followed(segments, data, reach)
        tried.append((error.mean(), np.median(ms), reach))
        print(f"# open3d, reach {1e3 * reach:g} mm: {np.median(ms):.1f} ms/frame, joints mean {error.mean():.1f}, "
              f"median {np.median(error):.1f} mm", flush=True)  # fmt: skip
    best = min(tried)
    print(json.dumps({"open3d_mm": best[0], "open3d_ms": best[1], "version": o3d.__version__}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
