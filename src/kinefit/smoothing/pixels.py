"""Pixels of a whole take as they are fitted: sides put right, without the bias that they have by direction of view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.view_bias import beside, trunks
from kinefit.smoothing.spool import stretches


def exchanged(channels: Channels, swapped: NDArray) -> tuple[NDArray, NDArray]:
    """Pixels (F, N, 2) and confidences (F, N) with sides put right, 0 where unseen."""
    if len(swapped) == len(channels.uv) and not swapped.any():
        unseen = ~np.isfinite(channels.uv).all(axis=2) & (channels.confidence != 0.0)
        return channels.uv, np.where(unseen, 0.0, channels.confidence) if unseen.any() else channels.confidence
    uv, confidence = room((*swapped.shape, 2)), room(swapped.shape)
    for some in stretches(len(swapped)):
        order = np.where(swapped[some], channels.partner, np.arange(swapped.shape[1]))
        uv[some] = np.take_along_axis(channels.uv[some], order[:, :, None], axis=1)
        sure = np.take_along_axis(channels.confidence[some], order, axis=1)
        confidence[some] = np.where(np.isfinite(uv[some]).all(axis=2), sure, 0.0)
    release(uv, confidence)
    return uv, confidence


def without_bias(body: Body, channels: Channels, uv: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
    """Pixels (T, N, 2) without the bias by view that keypoints have at states; the same where none is known."""
    if channels.view_bias is None:
        return uv
    points = channels.points
    trunk, out = trunks(body.tree)[points.segments][channels.column], room(uv.shape)
    for some in stretches(len(out)):
        for f in range(*some.indices(len(out))):
            x = body.positions(BodyState(roots[f], angles[f]), points)[channels.column]
            frames, _ = body.tree.forward(roots[f], angles[f])
            out[f] = uv[f] - beside(channels.view_bias, trunk, x, frames, channels.rig, channels.camera)
        release(uv, out)
    return out
