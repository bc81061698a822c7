"""Public names: Geometry in space: cameras, losses."""

from kinefit.geometry.camera import Camera as Camera, ImageFrame as ImageFrame, Rig as Rig
from kinefit.geometry.losses import geman_mcclure as geman_mcclure, huber as huber, tukey as tukey
