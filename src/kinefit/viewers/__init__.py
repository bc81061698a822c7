"""Interactive 3D scenes of motions and recordings, in a browser or in one HTML file."""

from kinefit.viewers.live import View
from kinefit.viewers.page import page
from kinefit.viewers.pictures import Pictures
from kinefit.viewers.player import Player
from kinefit.viewers.show import Choice, Recording

__all__ = ["Choice", "Pictures", "Player", "Recording", "View", "page"]
