"""People who are another one's image in a mirror.

Cameras see the image of a person in a mirror as one more person, who stands behind the glass and does the same with the
other side. The one plane about which it mirrors somebody in all frames gives it away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.multiview.people import PersonTrack
from kinefit.observations import Keypoints
from kinefit.sensors.channels import mirror_name

_FRAMES = 40  # of all in which both are seen
_MIN_FRAMES = 10
_MAX_MISS = 0.07  # [m] median of an image's points from where they belong: two detectors' errors of 3 to 5 cm each
_MIN_MOTION = 0.1  # [m] median by which a person's points move about: two who stand still mirror each other easily
_MIN_CONFIDENCE, _FITS = 0.1, 0.08  # of points that count, and share of the height within which views agree on them


def with_images(rig: Rig, keypoints: Sequence[Keypoints], people: Sequence[PersonTrack]) -> list[PersonTrack]:
    """The same people, those last who are another one's image in a mirror, with the number of that one.

    Parameters
    ----------
    rig : Rig
    keypoints : the records in which the people were found
    people : of several cameras, the one of whom most is seen first
    """
    of: dict[int, int] = {}
    for i, one in enumerate(people):
        for j, other in enumerate(people[:i]):
            if not {i, j} & of.keys() and (image := _image(rig, keypoints, one, other)) is not None:
                of |= {i: j} if image else {j: i}
    order = sorted(range(len(people)), key=lambda k: k in of)
    return [
        replace(
            people[k], image_of=order.index(of[k]) if k in of else None,
            maybe=tuple(sorted(order.index(m) for m in people[k].maybe)),
        ) for k in order
    ]  # fmt: skip


def _image(rig: Rig, keypoints: Sequence[Keypoints], one: PersonTrack, other: PersonTrack) -> bool | None:
    """Whether the first of two people is the other's image; None where neither is, the second where it is not."""
    both = np.flatnonzero((one.views > 1) & (other.views > 1))
    names = keypoints[0].names
    if len(both) < _MIN_FRAMES or any(k.names != names for k in keypoints):
        return None
    frames = both[np.unique(np.linspace(0, len(both) - 1, _FRAMES).astype(int))]
    exchanged = [names.index(m) if (m := mirror_name(name)) in names else k for k, name in enumerate(names)]
    a, b = (_points(rig, keypoints, person, frames) for person in (one, other))
    b = b[:, exchanged]
    seen = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2)
    if np.count_nonzero(seen.any(axis=1)) < _MIN_FRAMES:
        return None
    across, middle = (b - a)[seen], 0.5 * (a + b)[seen]
    normal = np.linalg.svd(across, full_matrices=False)[2][0]
    off = middle @ normal
    plane = float(np.median(off))
    miss = np.linalg.norm(across - np.outer(across @ normal, normal), axis=1) + 2.0 * np.abs(off - plane)
    moved = np.linalg.norm(a - np.nanmedian(a, axis=0), axis=2)[seen]
    if np.median(miss) > _MAX_MISS or np.median(moved) < _MIN_MOTION:
        return None
    cameras = np.median([camera.centre_world @ normal for camera in rig]) - plane
    return bool(np.median(a[seen] @ normal - plane) * cameras < 0.0)


def _points(rig: Rig, keypoints: Sequence[Keypoints], person: PersonTrack, frames: NDArray) -> NDArray:
    """(n, K, 3) [m] a person's points in some frames, NaN where fewer than two cameras see them."""
    chosen = [k.of_one(which) for k, which in zip(keypoints, person.chosen)]
    uv = np.stack(
        [np.where((k.confidence[frames, 0] > _MIN_CONFIDENCE)[..., None], k.points[frames, 0], np.nan) for k in chosen],
        axis=2,
    )
    height = float(np.nanmedian(np.ptp(uv[..., 1], axis=1)))
    own = rig.select(tuple(k.camera for k in keypoints))
    x, _, _ = triangulate_robust(own, uv.reshape(-1, *uv.shape[2:]), max_residual_px=max(_FITS * height, 1.0))
    return x.reshape(*uv.shape[:2], 3)
