"""The door of kinefit: `__init__.py` reads this list, and so do type checkers. More names stand in the rooms."""

# Bodies and cameras
from kinefit.bodies import Body as Body, BodyState as BodyState, PointSet as PointSet, load_body as load_body
from kinefit.bodies import parse_body as parse_body, save_body as save_body, catalogue as catalogue
from kinefit.geometry.camera import Camera as Camera, ImageFrame as ImageFrame, Rig as Rig

# What sensors saw of whole takes (records of one time: `kinefit.observations`)
from kinefit.observations import Keypoints as Keypoints, Markers as Markers

# From a recording to a motion, and files
from kinefit.readers.take.file import read_take as read_take
from kinefit.readers.take.load import load_observations as load_observations
from kinefit.takes.track import track_take as track_take
from kinefit.takes.batch.many import track_takes as track_takes
from kinefit.takes.check import check_take as check_take
from kinefit.takes.missing import find_cameras as find_cameras
from kinefit.fitting.tracking.recording import Recording as Recording
from kinefit.sensors.settings import TrackSettings as TrackSettings
from kinefit.fitting.tracking.video import track as track
from kinefit.fitting.tracking.tracker import Tracker as Tracker
from kinefit.fitting.frame.results import FrameResult as FrameResult
from kinefit.bodies.motion import Motion as Motion
from kinefit.readers.motion import read_motion as read_motion
from kinefit.exporters import write_motion as write_motion, write_report as write_report
from kinefit.readers.calibration.read import read_calibration as read_calibration
from kinefit.readers.landmarks.keypoints import read_keypoints as read_keypoints
from kinefit.readers.markers import read_markers as read_markers

# Markers with and without names, calibration
from kinefit.markers.frame.identify import identify as identify
from kinefit.markers.take.takes import identify_take as identify_take
from kinefit.markers.model.learn import learn_model as learn_model
from kinefit.fitting.tracking.video import fit_markers as fit_markers
from kinefit.fitting.markers.subject import fit_marker_subject as fit_marker_subject
from kinefit.rigs.board.calibrate import calibrate_board as calibrate_board
from kinefit.rigs.people.calibrate import calibrate_people as calibrate_people
from kinefit.rigs.refine.refine import refine as refine

# A sensor of one's own, errors
from kinefit.sensors.base import Measurement as Measurement, RowsOf as RowsOf, Sensor as Sensor
from kinefit.readers.take.kinds import SensorKind as SensorKind
from kinefit.solving.rows import Rows as Rows
from kinefit.errors import KinefitError as KinefitError

# Rooms that `kinefit.` reaches without an import of their own
from kinefit import geometry as geometry, bodies as bodies, observations as observations, solving as solving
from kinefit import images as images
from kinefit import readers as readers, sensors as sensors, markers as markers, fitting as fitting, rigs as rigs
from kinefit import exporters as exporters, takes as takes, papers as papers, simulation as simulation, studio as studio

__version__: str
