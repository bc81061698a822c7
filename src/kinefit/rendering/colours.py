"""The one set of colours in which a body is drawn: overlays, report, 3D viewer, live page and exported figures.

Left, right and middle are the blue, vermillion (an orange) and bluish green of M. Okabe and K. Ito (Color Universal
Design, 2008): people with any of the common colour vision deficiencies tell them apart. The colours of quality run
from blue over yellow to orange for the same reason.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

RGB = tuple[int, int, int]

LEFT_COLOUR, RIGHT_COLOUR, CENTRE_COLOUR = (0, 114, 178), (213, 94, 0), (0, 158, 115)
"""Of the segments on either side and in the middle."""

LOST_COLOUR = (190, 190, 190)
"""Of a segment that no measurement supports; its lines are dashed."""

_QUALITY = np.array([(86, 180, 233), (240, 228, 66), RIGHT_COLOUR], float)  # good, middling, bad


def side_colour(name: str) -> RGB:
    """RGB of a segment by its name, which ends in "_l", in "_r" or in neither."""
    return LEFT_COLOUR if name.endswith("_l") else RIGHT_COLOUR if name.endswith("_r") else CENTRE_COLOUR


def to_hex(colour: RGB) -> str:
    """RGB as pages and plots write it: "#0072b2"."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def quality_ramp(values: ArrayLike) -> NDArray[np.uint8]:
    """(..., 3) uint8 RGB of values (...): blue at 0 and below, yellow at 0.5, orange at 1 and above."""
    t = 2.0 * np.clip(np.asarray(values, float), 0.0, 1.0)[..., None]
    low = _QUALITY[0] + (_QUALITY[1] - _QUALITY[0]) * np.minimum(t, 1.0)
    return np.rint(low + (_QUALITY[2] - _QUALITY[1]) * np.maximum(t - 1.0, 0.0)).astype(np.uint8)
