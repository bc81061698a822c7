"""Interactive 3D scenes of motions and recordings, in a browser or in one HTML file."""

import warnings

from kinefit.studio.viewers.live import View
from kinefit.studio.viewers.player import Player
from kinefit.studio.viewers.show import Choice, ViewerContent, page
from kinefit.studio.viewers.stage import CameraImages

__all__ = ["CameraImages", "Choice", "Player", "View", "ViewerContent", "page"]


_RENAMED = {"Recording": ViewerContent, "Pictures": CameraImages}


def __getattr__(name: str) -> type[ViewerContent | CameraImages]:
    if name not in _RENAMED:
        raise AttributeError(f"module 'kinefit.studio.viewers' has no attribute '{name}'")
    warnings.warn(f"kinefit.studio.viewers.{name} is {_RENAMED[name].__name__} now", FutureWarning, stacklevel=2)
    return _RENAMED[name]
