"""Which cameras agree with each other: shows a wrong calibration, or a stream out of step, at a glance."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from kinefit.cli._screen import print_table, say

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from kinefit.geometry.camera import Rig
    from kinefit.observations import Keypoints
    from kinefit.readers.take.file import Take

_FRAMES = 50


def print_agreement(take: Take) -> None:
    """Print, for every two cameras, how far the points that both saw miss each other."""
    from kinefit.readers.take.load import load_observations

    seen = load_observations(take)
    rows = []
    for a, b in combinations(seen.keypoints, 2):
        if seen.rig is not None and a.camera != b.camera and a.names == b.names:
            errors = pair_errors(seen.rig, a, b)
            median = f"{np.median(errors):.1f} px" if len(errors) else "-"
            rows.append((f"{a.camera} - {b.camera}", str(len(errors)), median))
    say("\nA pair with a far larger error has a wrong calibration, differing clocks, or keypoints of another person.")
    print_table(("cameras", "shared points", "median reprojection error"), rows)


def pair_errors(rig: Rig, a: Keypoints, b: Keypoints) -> NDArray:
    """[px] distances between the points of two cameras and where the points in space that they give are seen."""
    from kinefit.geometry.triangulation import triangulate

    pair = rig.select((a.camera, b.camera))
    frames = np.unique(np.linspace(0, min(len(a), len(b)) - 1, _FRAMES).astype(int))
    uv = np.stack([_surest(a, frames), _surest(b, frames)], axis=1)  # (N, 2, 2)
    uv = uv[np.isfinite(uv).all(axis=(1, 2))]
    if not len(uv):
        return np.zeros(0)
    x = triangulate(pair, uv)
    shown = np.stack([camera.project(x) for camera in pair], axis=1)
    errors = np.linalg.norm(shown - uv, axis=-1).max(axis=1)
    return errors[np.isfinite(errors)]


def _surest(record: Keypoints, frames: NDArray) -> NDArray:
    """(N, 2) [px] points of the person that the detector was surest of in each frame, one frame after the other."""
    person = record.confidence[frames].sum(axis=-1).argmax(axis=1)
    return record.points[frames, person].reshape(-1, 2)
