"""Public names: Sensors, and what one's own needs."""

from kinefit.sensors.base import Hints as Hints
from kinefit.sensors.base import Measurement as Measurement
from kinefit.sensors.base import RowsOf as RowsOf
from kinefit.sensors.base import Sensor as Sensor
from kinefit.sensors.base import Unknown as Unknown
from kinefit.sensors.scene import Scene as Scene
from kinefit.sensors.settings import TrackSettings as TrackSettings
