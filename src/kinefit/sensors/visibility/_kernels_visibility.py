"""Kernels that judge segments: two layers of a rendered body, and the depths measured at their pixels."""

from __future__ import annotations

import numpy as np

from kinefit._jit import jit

OWN, UNIQUE, SHARED, EMPTY, COVERED, UNKNOWN, BLANK = range(7)
COUNTS = 7


@jit
def add_layer(layer, label, front, behind, owner, counts):
    """Add one segment's depth (N,) [m], inf for none, to the nearest (front) and second nearest (behind) depth.

    owner (N,) int32: label of the front; counts (S, COUNTS): `OWN` gets the segment's pixels. Without branches, so
    that the compiler handles many pixels at a time.
    """
    far, name = np.float32(np.inf), np.int32(label)
    for i in range(layer.size):
        z, f, b = layer[i], front[i], behind[i]
        second = z if z > f else f
        behind[i] = second if second < b else b
        owner[i] = name if z < f else owner[i]
        front[i] = z if z < f else f
    own = np.int32(0)
    for i in range(layer.size):
        own += np.int32(1) if layer[i] < far else np.int32(0)
    counts[label, OWN] = own


@jit
def measured(depth, across, down, out):
    """Write to out (h, w) uint8 whether the image has a depth at the pixels that `judge` samples."""
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            out[v, u] = depth[int((v + 0.5) * down), int((u + 0.5) * across)] != 0.0


@jit
def judge(
    front, behind, owner, depth, away, across, down, focal, slack, gap, constant, quadratic, rays, axes, end, counts,
    ends,
):  # fmt: skip
    """Count every segment's foremost pixels by the depth measured there.

    depth (H, W) [m] is 0 without a measurement and negative where it is known to belong to another object; `across` and
    `down` times as wide and high as front, behind and owner (h, w). A measurement agrees within
    slack + constant + quadratic z² [m], at the pixel or at one of four neighbours `slack` [m] away at that depth; focal
    [px] of the full image. A pixel without a measurement is blank if the nearest one is farther than `gap` [m] on the
    body, by away (h, w) [cells]. rays (2, H, W) of the full image and axes (S, 7) (`LimbEnds.axes`) give each pixel its
    place along a segment: empty and blank ones of fingers are unknown. ends (S, 2) gets, of the first `end` (0..1)
    of a segment's length, the foremost pixels and those that agree.
    """
    height, width = depth.shape
    for v in range(front.shape[0]):
        iv = int((v + 0.5) * down)
        for u in range(front.shape[1]):
            z = front[v, u]
            if not z < 1e30:
                continue
            iu = int((u + 0.5) * across)
            m = depth[iv, iu]
            bound = slack + constant + quadratic * z * z
            agrees = abs(m - z) <= bound
            if not agrees:
                offset = int(slack * focal / z + 0.5)
                above = iv - offset if iv >= offset else 0
                below = iv + offset if iv + offset < height else height - 1
                left = iu - offset if iu >= offset else 0
                right = iu + offset if iu + offset < width else width - 1
                agrees = abs(depth[above, iu] - z) <= bound or abs(depth[below, iu] - z) <= bound
                agrees = agrees or abs(depth[iv, left] - z) <= bound or abs(depth[iv, right] - z) <= bound
            s = owner[v, u]
            along = (z * rays[0, iv, iu] - axes[s, 0]) * axes[s, 3] + (z - axes[s, 2]) * axes[s, 5]
            along += (z * rays[1, iv, iu] - axes[s, 1]) * axes[s, 4]
            if along < end:
                ends[s, 0] += 1
                ends[s, 1] += 1 if agrees else 0
            z = behind[v, u]
            if agrees:
                kind = SHARED if abs(m - z) <= slack + constant + quadratic * z * z and z < 1e30 else UNIQUE
            elif m == 0.0:
                kind = BLANK if away[v, u] * across * front[v, u] > gap * focal else UNKNOWN
            elif abs(-m - front[v, u]) <= bound:
                kind = UNKNOWN
            else:
                kind = EMPTY if abs(m) > front[v, u] else COVERED
            if along > axes[s, 6] and (kind == EMPTY or kind == BLANK):
                kind = UNKNOWN
            counts[s, kind] += 1
