"""Left taken for right: a detector sometimes exchanges a person's sides in one view; found by the body's own pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.sensors.channels import Channels

_TRUNCATE = 9.0  # squared standard deviations beyond which a point says no more
_ODDS = 8.0  # how much cheaper the exchange must be: e⁻⁴ against the detector having erred


def limb_groups(body: Body, channels: Channels) -> NDArray:
    """(N,) int: channels that swap together, by the branch of the tree they are on (legs; trunk with arms)."""
    tree = body.tree
    branches: dict[str, int] = {}
    out = np.zeros(len(channels.column), np.int64)
    for n, k in enumerate(channels.column):
        s = int(channels.points.segments[k])
        while tree.parents[s] > 0:
            s = int(tree.parents[s])
        name = tree.segments[s]
        name = name[:-2] if name.endswith(("_l", "_r")) else name
        out[n] = branches.setdefault(name, len(branches))
    return out


def find_swaps(
    channels: Channels, groups: NDArray, uv: NDArray, weight: NDArray, fitted: NDArray,
    sides_known: NDArray | None = None,
) -> NDArray:  # fmt: skip
    """(N,) bool: channels of one frame to exchange with their partner.

    Parameters
    ----------
    groups : (N,) int from `limb_groups`.
    uv, fitted : (N, 2) [px] measured, and where the body would be seen.
    weight : (N,) [1/px²], 0 where unseen.
    sides_known : (N,) bool, channels that stay as they are; None: none
    """
    partner = channels.partner
    paired = partner != np.arange(len(partner))
    as_is, turned = _cost(uv - fitted, weight), _cost(uv - fitted[partner], weight)
    key = channels.source * (groups.max(initial=0) + 1) + groups
    gain = np.bincount(key[paired], (as_is - turned)[paired], minlength=key.max(initial=0) + 1)
    swapped: NDArray = paired & (gain[key] > _ODDS)
    return swapped if sides_known is None else swapped & ~sides_known


def _cost(gap: NDArray, weight: NDArray) -> NDArray:
    cost = np.minimum(weight * (gap[:, 0] ** 2 + gap[:, 1] ** 2), _TRUNCATE)
    cost[np.isnan(cost)] = 0.0
    return cost
