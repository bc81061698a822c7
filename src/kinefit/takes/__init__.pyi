"""Public names: Whole takes."""

from kinefit.takes.batch.many import track_takes as track_takes
from kinefit.takes.batch.results import MotionFormat as MotionFormat
from kinefit.takes.check import check_take as check_take
from kinefit.takes.missing import find_cameras as find_cameras
from kinefit.takes.track import track_take as track_take
