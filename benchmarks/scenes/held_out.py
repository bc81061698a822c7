"""What a fit says of a camera that it did not have: its keypoints where the body, and the bias by view, put them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit import Keypoints, Motion, Recording, Rig
from kinefit.sensors.channels import Channels, make_channels
from kinefit.sensors.points.keypoints import Layout, projected
from kinefit.sensors.points.views import ViewBias, find_swaps, limb_groups
from kinefit.sensors.scene import Scene

_SURE = 0.3  # confidence of keypoints that are held against the fit
_SIGMA = 8.0  # [px] at which sides count as exchanged, as for a take that states nothing


def persons(rig: Rig, keypoints: Sequence[Keypoints]) -> list[Keypoints]:
    """Records of the one who is followed, among all who were detected."""
    return list(Recording.of_keypoints(rig, keypoints).keypoints)


def sides_right(motion: Motion, rig: Rig, people: Sequence[Keypoints]) -> tuple[Channels, NDArray]:
    """Keypoints of one person as channels with left and right as the motion has them, and (F, N, 2) [px] where it has
    each of them, bias by view included."""
    channels = make_channels(motion.body, rig, people, [_SIGMA] * len(people))
    channels = ViewBias.from_record(motion.provenance.get("view bias", {})).known_to(channels)
    layout, groups = Layout(channels, motion.body), limb_groups(motion.body, channels)
    fitted = np.empty(channels.uv.shape)
    uv, confidence = np.array(channels.uv), np.array(channels.confidence)
    for f, weight in enumerate(channels.weight):
        scene = Scene(motion.body, motion.state(f), channels.rig)
        offset = layout.bias(scene)
        fitted[f] = projected(scene, layout) + (0.0 if offset is None else offset)
        swapped = find_swaps(channels, groups, uv[f], weight, fitted[f])
        order = np.where(swapped, channels.partner, np.arange(len(swapped)))
        uv[f], confidence[f] = uv[f, order], confidence[f, order]
    channels.uv[:], channels.confidence[:] = uv, confidence
    return channels, fitted


def left_over(motion: Motion, rig: Rig, person: Keypoints) -> NDArray:
    """(F, N, 2) [px] of one camera's sure keypoints: measured minus where a motion fitted without it has them."""
    channels, fitted = sides_right(motion, rig.select((person.camera,)), [person])
    return np.where(channels.confidence[..., None] > _SURE, channels.uv - fitted, np.nan)


def cameras_left_out(
    rig: Rig, judge: Sequence[Keypoints], fitted: Callable[[str], Motion]
) -> dict[str, NDArray]:
    """{camera: `left_over`} of one person's records; `fitted` gives the motion that did not have a camera."""
    return {one.camera: left_over(fitted(one.camera), rig, one) for one in judge}


def median(errors: dict[str, NDArray]) -> float:
    """[px] of all cameras together."""
    return float(np.nanmedian(np.concatenate([np.linalg.norm(e, axis=-1).ravel() for e in errors.values()])))
