"""What the turns of a body's joints say for and against explanations of a frame: learnt axes and limits.

The search looks at a segment beside its parent alone; here whole explanations that come near each other are compared.
A turn that a segment's own points do not tell comes from its parent's, so that toes are held by the knee's axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame._kernels_posture import turn_costs
from kinefit.identification.frame.search import LabelSearch
from kinefit.identification.frame.tables import segment_tables
from kinefit.identification.model.model import MarkerModel

MOST = 6.0
"""That the turn of one joint costs at most: people do move as no training shows."""


@dataclass(frozen=True, eq=False)
class PostureModel:
    """A model's segments, parents first, in this `order`, as the kernel wants them: see `turn_costs`."""

    order: NDArray
    starts: NDArray
    markers: NDArray
    x: NDArray
    parent: NDArray
    here: NDArray
    there: NDArray
    spread: NDArray
    middle: NDArray
    give: NDArray


@lru_cache(maxsize=64)
def posture_of(model: MarkerModel) -> PostureModel | None:
    """The tables of a model; None where no motion taught it any joint's turns."""
    joints = {j.child: j for j in model.joints}
    if all(j.turn is None for j in model.joints):
        return None
    tables = segment_tables(model, 0)
    order = np.array([t.index for t in tables])
    place = {s: i for i, s in enumerate(order.tolist())}
    count = len(tables)
    middle, give = np.tile(np.eye(3), (count, 1, 1)), np.full((count, 3, 3), -1.0)
    for i, t in enumerate(tables):
        joint = joints.get(t.index)
        if joint is not None and joint.turn is not None and joint.give is not None:
            middle[i], give[i] = joint.turn, joint.give
    zero = np.zeros(3)
    return PostureModel(
        order, np.concatenate([[0], np.cumsum([len(t.markers) for t in tables])]),
        np.concatenate([t.markers for t in tables]), np.concatenate([t.x for t in tables]),
        np.array([place.get(t.parent, -1) for t in tables]),
        np.array([zero if t.joint_here is None else t.joint_here for t in tables]),
        np.array([zero if t.joint_there is None else t.joint_there for t in tables]),
        np.array([t.spread for t in tables]), middle, give,
    )  # fmt: skip


def unusual(model: MarkerModel, search: LabelSearch, labels: NDArray) -> NDArray:
    """(E,) what the posture costs under explanations (E, M), -log likelihood; 0 where no motion taught the model."""
    known, out = posture_of(model), np.zeros(len(labels))
    if known is not None:
        sigma = np.concatenate([search.sigma[s] for s in known.order.tolist()])
        turn_costs(
            np.ascontiguousarray(labels), search.frame.points, known.starts, known.markers, known.x, sigma,
            known.parent, known.here, known.there, known.spread, known.middle, known.give, MOST, out,
        )  # fmt: skip
    return out
