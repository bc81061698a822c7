"""Interactive 3D scenes of motions and recordings, in a browser or in one HTML file."""

import warnings

from kinefit.viewers.live import View
from kinefit.viewers.player import Player
from kinefit.viewers.show import Choice, ViewerContent, page
from kinefit.viewers.stage import CameraImages

__all__ = ["CameraImages", "Choice", "Player", "View", "ViewerContent", "page"]


_RENAMED = {"Recording": ViewerContent, "Pictures": CameraImages}


def __getattr__(name: str) -> type[ViewerContent | CameraImages]:
    if name not in _RENAMED:
        raise AttributeError(f"module 'kinefit.viewers' has no attribute '{name}'")
    warnings.warn(f"kinefit.viewers.{name} is {_RENAMED[name].__name__} now", FutureWarning, stacklevel=2)
    return _RENAMED[name]
