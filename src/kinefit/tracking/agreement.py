"""Sensors that contradict each other: which, and by how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.motion import Residuals
from kinefit.rows import Rows
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.scene import Scene

CONTRADICTION_SIGMAS = 3.0
"""Standard deviations, as they are stated, that half of a sensor's residuals must exceed to be a contradiction."""

LOOKS = 12  # frames that are looked at, spread over the take
_RAYLEIGH = 1.177  # median length of a vector whose two parts have a standard deviation of 1
_MIN_MEASURED_SHARE = 1e-6  # share of a direction that nothing measures


def contradictions(scenes: Sequence[Scene], matched: Sequence[Sequence[Matched]]) -> dict[str, dict[str, Any]]:
    """Sensors whose residuals are larger than they can be if they and all others are right.

    Parameters
    ----------
    scenes : of some frames, at the fitted states
    matched : of each, the matches of all sensors

    Returns
    -------
    {sensor: {"deviations": median in stated standard deviations, "median_m": float, "shift_m": [x, y, z]}}
        The worst first; none where the fit has but one sensor, whose residuals contradict no other. `shift_m` is
        where the sensor has its points, beside where all sensors together have them.
    """
    kept: dict[str, list[Rows]] = {}
    for scene, several in zip(scenes, matched):
        for m in several:
            kept.setdefault(m.sensor, []).extend(r for r in rows_at(m, scene) if isinstance(r, Rows))
    if len(kept) < 2:
        return {}
    summaries = {sensor: _summary(rows) for sensor, rows in kept.items() if rows}
    far = {sensor: t for sensor, t in summaries.items() if t["deviations"] > CONTRADICTION_SIGMAS}
    return dict(sorted(far.items(), key=lambda one: -one[1]["deviations"]))


def cameras_apart(residuals: Mapping[str, Residuals], sigma: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Cameras whose keypoints lie far from the fit while those of the others do not: moved, or calibrated otherwise.

    Parameters
    ----------
    residuals : of all sensors
    sigma : {camera: [px]} standard deviation of a sure keypoint, as it is stated

    Returns
    -------
    {camera: {"deviations": float, "median_px": float, "others_px": float}}
        Of three cameras or more; deviations are of what is stated, or of the others' where these are larger.
    """
    medians = {}
    for name, one in residuals.items():
        if name in sigma and one.unit == "px" and np.isfinite(one.norms).any():
            medians[name] = float(np.nanmedian(one.norms))
    found: dict[str, dict[str, Any]] = {}
    for name, median in medians.items() if len(medians) > 2 else ():
        others = float(np.median([m for other, m in medians.items() if other != name]))
        deviations = median / max(_RAYLEIGH * sigma[name], others)
        if deviations > CONTRADICTION_SIGMAS:
            found[name] = {
                "deviations": round(deviations, 2), "median_px": round(median, 1), "others_px": round(others, 1)
            }
    return dict(sorted(found.items(), key=lambda one: -one[1]["deviations"]))


def sentences(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The same in words, one for each sensor."""
    return [
        f"{sensor} contradicts the other cameras: half of its keypoints lie {t['median_px']:.0f} px or more from the "
        f"fit, those of the others {t['others_px']:.0f} px. It has a low weight; see kinefit check"
        if "median_px" in t else
        f"{sensor} contradicts the other sensors: half of its residuals exceed {1000 * t['median_m']:.0f} mm, "
        f"{t['deviations']:.1f} of its standard deviations. It is shifted by "
        f"({', '.join(f'{1000 * v:+.0f}' for v in t['shift_m'])}) mm"
        for sensor, t in found.items()
    ]


def _summary(rows: Sequence[Rows]) -> dict[str, Any]:
    data = np.concatenate([np.zeros((8, 0)), *(r.data for r in rows)], axis=1)
    size, square = (np.concatenate([np.zeros(0), *parts]) for parts in zip(*(_points(r) for r in rows)))
    direction, residual, weight = data[3:6], data[6], data[7]
    if not len(size):
        return {"deviations": 0.0, "median_m": 0.0, "shift_m": [0.0, 0.0, 0.0]}
    A = (direction * weight) @ direction.T
    shift = np.linalg.pinv(A, rcond=_MIN_MEASURED_SHARE, hermitian=True) @ (direction @ (weight * residual))
    return {
        "deviations": round(float(np.sqrt(np.median(square))), 2), "median_m": round(float(np.median(size)), 4),
        "shift_m": [round(float(v), 4) for v in shift],
    }  # fmt: skip


def _points(rows: Rows) -> tuple[NDArray, NDArray]:
    """Residual [m] of each measurement in some rows, and its square in variances."""
    felt = rows.weight > 0.0
    ids = np.where(rows.group < 0, rows.group.max(initial=-1) + 1 + np.arange(len(rows)), rows.group)[felt]
    own = np.unique(ids, return_inverse=True)[1]
    residual = rows.residual[felt]
    return np.sqrt(np.bincount(own, residual**2)), np.bincount(own, rows.weight[felt] * residual**2)
