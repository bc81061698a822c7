"""Public names: Geometry in space: cameras, losses."""

from kinefit.geometry.camera import Camera as Camera
from kinefit.geometry.camera import ImageFrame as ImageFrame
from kinefit.geometry.camera import Rig as Rig
from kinefit.geometry.losses import geman_mcclure as geman_mcclure
from kinefit.geometry.losses import huber as huber
from kinefit.geometry.losses import tukey as tukey
