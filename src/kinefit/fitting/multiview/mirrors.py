"""Detect people that are mirror images of others.

Cameras see a mirror image as one more person, behind the glass and with sides swapped. It is detected by one plane that
mirrors the other person in all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.fitting.multiview.association import heights, medians
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name

_MAX_FRAMES = 40  # of those in which both are visible
_MIN_FRAMES = 10
_MAX_MIRROR_ERROR = 0.07  # [m] median error of the mirrored points: detections have errors of 3 to 5 cm each
_MIN_MOTION = 0.1  # [m] median motion of a person's points: two who stand still may be symmetric by chance
_MIN_CONFIDENCE = 0.1  # of points that are used
_MAX_ERROR = 0.08  # reprojection error of a point relative to the person's height


def mark_mirror_images(rig: Rig, keypoints: Sequence[Keypoints], people: Sequence[PersonTrack]) -> list[PersonTrack]:
    """Set `image_of` of people that are mirror images of others, and move them to the end of the list.

    Parameters
    ----------
    rig : Rig
    keypoints : the records in which the people were found
    people : seen by several cameras, in order of decreasing confidence
    """
    source_of: dict[int, int] = {}
    for i, one in enumerate(people):
        for j, other in enumerate(people[:i]):
            if not {i, j} & source_of.keys() and (image := _is_mirror_image(rig, keypoints, one, other)) is not None:
                source_of |= {i: j} if image else {j: i}
    order = sorted(range(len(people)), key=lambda k: k in source_of)
    return [
        replace(
            people[k], image_of=order.index(source_of[k]) if k in source_of else None,
            maybe=tuple(sorted(order.index(m) for m in people[k].maybe)),
        ) for k in order
    ]  # fmt: skip


def _is_mirror_image(rig: Rig, keypoints: Sequence[Keypoints], one: PersonTrack, other: PersonTrack) -> bool | None:
    """Whether the first of two people is the second's mirror image (True), or the reverse (False); None: neither."""
    both = np.flatnonzero((one.views > 1) & (other.views > 1))
    names = keypoints[0].names
    if len(both) < _MIN_FRAMES or any(k.names != names for k in keypoints):
        return None
    frames = both[np.unique(np.linspace(0, len(both) - 1, _MAX_FRAMES).astype(int))]
    swapped_columns = [names.index(m) if (m := mirror_name(name)) in names else k for k, name in enumerate(names)]
    a, b = (_points(rig, keypoints, person, frames) for person in (one, other))
    b = b[:, swapped_columns]
    visible = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2)
    if np.count_nonzero(visible.any(axis=1)) < _MIN_FRAMES:
        return None
    across, middle = (b - a)[visible], 0.5 * (a + b)[visible]
    normal = np.linalg.svd(across, full_matrices=False)[2][0]
    offsets = middle @ normal
    plane = float(np.median(offsets))
    miss = np.linalg.norm(across - np.outer(across @ normal, normal), axis=1) + 2.0 * np.abs(offsets - plane)
    motion = np.linalg.norm(a - medians(np.moveaxis(a, 0, -1)), axis=2)[visible]
    if np.median(miss) > _MAX_MIRROR_ERROR or np.median(motion) < _MIN_MOTION:
        return None
    cameras = np.median([camera.centre_world @ normal for camera in rig]) - plane
    return bool(np.median(a[visible] @ normal - plane) * cameras < 0.0)


def _points(rig: Rig, keypoints: Sequence[Keypoints], person: PersonTrack, frames: NDArray) -> NDArray:
    """(n, K, 3) [m] triangulated points of a person in some frames; NaN with fewer than two cameras."""
    chosen = [k.of_one(which) for k, which in zip(keypoints, person.chosen)]
    uv = np.stack(
        [np.where((k.confidence[frames, 0] > _MIN_CONFIDENCE)[..., None], k.points[frames, 0], np.nan) for k in chosen],
        axis=2,
    )
    height = float(medians(heights(np.moveaxis(uv, 1, 2)).ravel()))
    own = rig.select(tuple(k.camera for k in keypoints))
    x, _, _ = triangulate_robust(own, uv.reshape(-1, *uv.shape[2:]), max_residual_px=max(1.0, _MAX_ERROR * height))
    return x.reshape(*uv.shape[:2], 3)
