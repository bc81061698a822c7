"""Find lenses with distortion for which the calibration states none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.arrangement import median_error, sample
from kinefit.diagnostics.bias import disagreement, without_points
from kinefit.diagnostics.views import KeypointViews, meet
from kinefit.findings import Finding, listed
from kinefit.geometry.camera import Rig

_MAX_ERROR_RATIO = 0.8
"""Error with distortion to error without: 0.57 and 0.74 in two real recordings of wide lenses whose distortion was
removed; 0.89 and more for lenses with almost none."""
_MIN_EXPLAINED_PX = 5.0  # root mean square that distortion explains: systematic detector errors explain up to 5
_MIN_OVER_MOVED = 0.75  # of what one moved camera explains: distorted lenses 0.83 and 1.02, moved cameras up to 0.69
_MAX_K1 = 0.7  # |k1| of real lenses: fisheyes have another model


def distortion_findings(views: KeypointViews) -> list[Finding]:
    """Findings on lenses with distortion for which the calibration states none.

    Solves for one radial coefficient k1 of each of these cameras, with the points in space eliminated.
    """
    ideal = [c for c, camera in enumerate(views.rig) if not np.any(camera.distortion)]
    if len(views.rig) < 3 or not ideal:
        return []
    k1, explained, together = _solve(views, ideal)
    if together < _MIN_EXPLAINED_PX or np.max(np.abs(k1)) > _MAX_K1:
        return []
    parts = disagreement(views)
    if together < _MIN_OVER_MOVED * max(parts.explained(parts.of(c)) for c in range(len(views.rig))):
        return []
    cameras = list(views.rig)
    for c, k in zip(ideal, k1, strict=True):
        cameras[c] = replace(cameras[c], distortion=np.array([k, 0.0, 0.0, 0.0]), model="radtan")
    uv = sample(views)
    before, after = median_error(views.rig, uv), median_error(Rig(tuple(cameras)), uv)
    if not after <= _MAX_ERROR_RATIO * before:
        return []
    bent = [n for n in np.argsort(-explained) if explained[n] >= 0.5 * np.max(explained)]
    names = tuple(views.rig.names[ideal[n]] for n in bent)
    coefficients = listed(f"{name} as if k1 were {k1[n]:+.2f}" for n, name in zip(bent, names))
    text = f"The calibration has no lens distortion for {listed(names)}, but the keypoints show it: {coefficients}."
    confidence = f"Certain: with it the cameras' median error falls from {before:.1f} to {after:.1f} px."
    remedy = "Add the distortion coefficients of these lenses to the calibration."
    return [Finding("fault", "distortion", text, names, confidence, remedy)]


def _solve(views: KeypointViews, ideal: list[int]) -> tuple[NDArray, NDArray, float]:
    """k1 (N,) of the ideal cameras, and the root mean square [px] that each alone and all together explain."""
    x, agree = meet(views)
    use = (agree.sum(axis=2) >= 2) & np.isfinite(x[..., 0])
    x, agree, uv = x[use], agree[use], views.uv[use]
    count, cameras = len(x), len(views.rig)
    freedom = int(2 * agree.sum() - 3 * count)
    if freedom < 1:
        return np.zeros(len(ideal)), np.zeros(len(ideal)), 0.0
    jacobian, design = np.zeros((count, 2 * cameras, 3)), np.zeros((count, 2 * cameras, len(ideal)))
    residual = np.zeros((count, 2 * cameras))
    for c, camera in enumerate(views.rig):
        predicted, by_point = camera.project_with_jacobian(x)
        agreed, rows = agree[:, c, None], slice(2 * c, 2 * c + 2)
        jacobian[:, rows] = np.where(agreed[..., None], by_point, 0.0)
        residual[:, rows] = np.where(agreed, predicted - uv[:, c], 0.0)
        if c in ideal:
            off = predicted - camera.matrix[:2, 2]
            squared = np.sum(np.square(off / np.diag(camera.matrix)[:2]), axis=1)
            design[:, rows, ideal.index(c)] = np.where(agreed, off * squared[:, None], 0.0)
    matrix, right = (part.sum(0) for part in without_points(jacobian, design, residual))
    power = np.maximum(np.diag(matrix), 1e-12)
    k1 = -np.linalg.lstsq(matrix, right, rcond=None)[0]
    together = float(np.sqrt(max(-k1 @ right, 0.0) / freedom))
    return k1, np.abs(right) / np.sqrt(power * freedom), together
