"""Check that 2D keypoints are pixels with a confidence: no shares of the image's size, depths, logits, percentages."""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError

_MAX_SCORE = 20.0  # heatmaps of OpenPose and HRNet reach 1.4, the SimCC heads of RTMW about 10, percentages 50 and more
_MIN_SCORE_EXCESS = 1.5  # no detector scores nearly all of its points higher: heatmaps 1.0 to 1.3 at their best
_OVERSHOOT = 0.1  # by which scores of heatmaps may fall below 0
_MAX_OVERSHOOT_SHARE = 0.01  # of scores that lie lower
_MAX_NEGATIVE_SHARE = 0.1  # of scores below 0: a depth relative to the hips has about half of them there
_MAX_SHARE_OF_IMAGE = 2.0  # a coordinate as a share of the image's size, of a point outside of the image too
_MIN_POINTS = 10  # that distinguish shares of the image from pixels in one corner
_MIN_SPREAD = 0.01  # of these, as a share of the image's size: a person; less is one place
_INSTEAD = (
    "Write the detector's confidence or visibility, 0 to 1, in its place. Without one, write 1 where a point is "
    "detected and 0 elsewhere."
)


def confidence_of(scores: NDArray, what: str, file: str | PathLike[str] | None = None) -> NDArray:
    """Confidence 0..1 of a detector's scores (any shape), 0 for undetected points.

    Scores of heatmaps exceed 1 and fall below 0 by little; they are clipped. COCO's flags 0 (not labelled), 1
    (occluded) and 2 (visible) become 0, 0.5 and 1, and -1 for an undetected point 0.

    Parameters
    ----------
    what, file : whose scores, and of which file, for the message.

    Raises
    ------
    ObservationError
        The values cannot be scores: depths, logits or percentages.
    """
    low, high = (float(of.reduce(scores, axis=None, initial=0.0)) for of in (np.fmin, np.fmax))
    if low >= 0.0 and high <= 1.0:
        return scores
    values = scores[np.isfinite(scores) & (scores != 0.0) & (scores != -1.0)]
    if not len(values):
        return np.maximum(scores, 0.0)
    if high == 2.0 and np.isin(values, (1.0, 2.0)).all():
        return np.clip(scores / 2.0, 0.0, 1.0)
    negative = float(np.mean(values < 0.0))
    is_high = np.percentile(values, 5) > _MIN_SCORE_EXCESS or np.percentile(values, 99) > _MAX_SCORE
    if negative > _MAX_NEGATIVE_SHARE or np.mean(values < -_OVERSHOOT) > _MAX_OVERSHOOT_SHARE:
        extent, cause = f", {100 * negative:.0f} % of them below 0", "This is a depth (z of MediaPipe), or logits."
    elif is_high and 50.0 < high <= 100.0:
        extent, cause = "", "If these are percentages, divide them by 100. Else this may be a depth."
    elif is_high:
        extent, cause = "", "This may be a depth, or logits."
    else:
        return np.clip(scores, 0.0, 1.0)
    extent = f"from {values.min():.3g} to {high:.3g}{extent}"
    problem = f"{what}: the value after x and y is no confidence or visibility: {extent}"
    raise ObservationError(problem, file=file, remedy=f"{cause} {_INSTEAD}")


def check_pixels(points: NDArray, confidence: NDArray, what: str, file: str | PathLike[str] | None = None) -> None:
    """Check that the coordinates of points (..., 2) with a confidence (...) 0..1 are pixels.

    Raises
    ------
    ObservationError
        They are shares of the image's size.
    """
    if any(abs(of.reduce(points, axis=None, initial=0.0)) > _MAX_SHARE_OF_IMAGE for of in (np.fmin, np.fmax)):
        return
    uv = points[(confidence > 0.0) & np.isfinite(points).all(axis=-1)]
    if len(uv) >= _MIN_POINTS and np.ptp(np.percentile(uv, (10, 90), axis=0), axis=0).max() > _MIN_SPREAD:
        problem = f"{what}: coordinates run from 0 to 1 (shares of the image's size), not over pixels"
        remedy = "Multiply x by the image's width and y by its height."
        raise ObservationError(problem, file=file, remedy=remedy)
