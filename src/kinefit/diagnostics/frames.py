"""In which picture keypoints are, the video's or the calibration's, where the two differ: as told, or the other way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kinefit.diagnostics.arrangement import disagreement_share, sample
from kinefit.diagnostics.views import KeypointViews
from kinefit.findings import Finding, listed
from kinefit.geometry.camera import ImageFrame

_BETTER = 0.7  # of the cameras' mean error: a few pixels of difference are lost among those of a detector


def frame_findings(
    views: KeypointViews, images: Mapping[str, ImageFrame], told: Mapping[str, str]
) -> tuple[list[Finding], KeypointViews]:
    """A fault where the cameras agree far better with the keypoints in the other picture; and the views so.

    Parameters
    ----------
    views : KeypointViews with the keypoints read as told.
    images : {camera: ImageFrame} of the videos.
    told : {camera: "video" or "calibration"}
        Only of cameras whose keypoints' picture the take tells.
    """
    names = [n for n in told if n in views.rig and not np.allclose(images[n].T_image_calibration, np.eye(3), atol=1e-9)]
    fits: tuple[str, ...] = ()
    best, before = views, disagreement_share(views.rig, sample(views))
    least = _BETTER * before
    for which in dict.fromkeys((tuple(names), *((name,) for name in names))):
        other = _otherwise(views, images, told, which)
        share = disagreement_share(other.rig, sample(other)) if which else 1.0
        if share < least:
            best, least, fits = other, share, which
    if not fits:
        return [], views
    right = "calibration" if told[fits[0]] == "video" else "video"
    text = f"The keypoints of {listed(fits)} are not in the {told[fits[0]]}'s image, but in the {right}'s."
    sure = f"Sure: the cameras' mean error falls to {100 * least / before:.0f} %."
    remedy = f'Write frame = "{right}" into [[keypoints]] of {listed(fits)}.'
    return [Finding("fault", "frame", text, tuple(fits), sure, remedy)], best


def _otherwise(
    views: KeypointViews, images: Mapping[str, ImageFrame], told: Mapping[str, str], which: tuple[str, ...]
) -> KeypointViews:
    """The views with the keypoints of some cameras in the other picture than told."""
    uv = views.uv.copy()
    for name in which:
        c = views.rig.index(name)
        change = images[name].from_calibration if told[name] == "video" else images[name].to_calibration
        uv[:, :, c] = change(uv[:, :, c])
    return replace(views, uv=uv)
