"""Interactive 3D scenes of motions and recordings, in a browser or in one HTML file."""

import warnings

from kinefit.viewers.live import View
from kinefit.viewers.page import page
from kinefit.viewers.pictures import CameraImages
from kinefit.viewers.player import Player
from kinefit.viewers.show import Choice, ViewerContent

__all__ = ["CameraImages", "Choice", "Player", "View", "ViewerContent", "page"]


def __getattr__(name: str) -> type[ViewerContent]:
    if name != "Recording":
        raise AttributeError(f"module 'kinefit.viewers' has no attribute '{name}'")
    warnings.warn("kinefit.viewers.Recording is ViewerContent now", FutureWarning, stacklevel=2)
    return ViewerContent
