"""The public names of kinefit and where each is defined: `__init__.py` reads this list, and so do type checkers."""

# Bodies and cameras
from kinefit.bodies import Body as Body, BodyState as BodyState, PointSet as PointSet, catalogue as catalogue
from kinefit.bodies import load_body as load_body, parse_body as parse_body, save_body as save_body
from kinefit.geometry.camera import Camera as Camera, ImageFrame as ImageFrame, Rig as Rig

# What sensors saw: whole takes, and frames of one time
from kinefit.observations import Keypoints as Keypoints, Markers as Markers
from kinefit.observations import BodyTrackerFrame as BodyTrackerFrame
from kinefit.observations import ClickFrame as ClickFrame, ColourFrame as ColourFrame, DepthFrame as DepthFrame
from kinefit.observations import KeypointFrame as KeypointFrame, LineFrame as LineFrame
from kinefit.observations import MarkerFrame as MarkerFrame, PointCloud as PointCloud
from kinefit.observations import SilhouetteFrame as SilhouetteFrame, SurfacePointFrame as SurfacePointFrame

# A sensor of one's own
from kinefit.geometry.losses import geman_mcclure as geman_mcclure, huber as huber, tukey as tukey
from kinefit.solving.rows import Rows as Rows
from kinefit.sensors.base import Hints as Hints, Measurement as Measurement, RowsOf as RowsOf, Sensor as Sensor
from kinefit.sensors.base import Unknown as Unknown
from kinefit.observations import SensorRecording as SensorRecording
from kinefit.readers.take.kinds import Proposal as Proposal, SensorKind as SensorKind, TakeEntry as TakeEntry
from kinefit.sensors.scene import Scene as Scene

# Formats of one's own
from kinefit.takes.batch.results import MotionFormat as MotionFormat
from kinefit.readers.plugins import FileFormat as FileFormat

# From a recording to a motion
from kinefit.takes.batch.many import track_takes as track_takes
from kinefit.takes.missing import find_cameras as find_cameras
from kinefit.fitting.frame.results import FrameResult as FrameResult
from kinefit.bodies.motion import Motion as Motion
from kinefit.exporters.report.angles import range_changes as range_changes
from kinefit.readers.take.file import read_take as read_take
from kinefit.readers.take.load import load_observations as load_observations
from kinefit.sensors.settings import TrackSettings as TrackSettings
from kinefit.fitting.smoothing.online.fixed_lag import FixedLag as FixedLag
from kinefit.fitting.smoothing.online.fixed_lag import KnownNoise as KnownNoise
from kinefit.fitting.subject.fit import fit_subject as fit_subject
from kinefit.fitting.subject.subject import OwnUnknowns as OwnUnknowns
from kinefit.fitting.tracking.recording import Recording as Recording
from kinefit.takes.track import track_take as track_take
from kinefit.fitting.tracking.tracker import Tracker as Tracker
from kinefit.fitting.tracking.video import track as track

# Markers, with and without names
from kinefit.markers.audit.audit import audit_take as audit_take
from kinefit.markers.frame.identify import identify as identify
from kinefit.markers.model.from_frame import model_from_frame as model_from_frame
from kinefit.markers.model.learn import training_gate as training_gate
from kinefit.markers.model.learn import learn_model as learn_model
from kinefit.markers.take.takes import identify_people as identify_people
from kinefit.markers.take.takes import identify_take as identify_take
from kinefit.fitting.markers.subject import split_people as split_people
from kinefit.fitting.markers.subject import fit_marker_subject as fit_marker_subject
from kinefit.fitting.tracking.video import fit_markers as fit_markers

# Calibration, and checks of a recording
from kinefit.rigs.board.calibrate import calibrate_board as calibrate_board
from kinefit.takes.check import check_take as check_take
from kinefit.rigs.people.calibrate import calibrate_people as calibrate_people
from kinefit.rigs.refine.refine import refine as refine

# Solvers
from kinefit.solving.equations import covariance as covariance, joint_std as joint_std
from kinefit.solving.functional_joints import functional_axis as functional_axis
from kinefit.solving.functional_joints import functional_centre as functional_centre
from kinefit.solving.least_squares import gauss_newton as gauss_newton, levenberg_marquardt as levenberg_marquardt

# Files
from kinefit.exporters import write_bvh as write_bvh, write_c3d as write_c3d, write_csv as write_csv
from kinefit.exporters import write_glb as write_glb, write_markers as write_markers, write_mot as write_mot
from kinefit.exporters import write_motion as write_motion, write_osim as write_osim, write_report as write_report
from kinefit.exporters import write_trc as write_trc
from kinefit.readers.calibration.read import read_calibration as read_calibration
from kinefit.readers.calibration.read import write_calibration as write_calibration
from kinefit.readers.calibration.write import write_calibration_like as write_calibration_like
from kinefit.readers.depth.recordings import read_clouds as read_clouds, read_depth as read_depth
from kinefit.readers.landmarks.detections import read_detections as read_detections
from kinefit.readers.landmarks.keypoints import read_caliscope_csv as read_caliscope_csv
from kinefit.readers.landmarks.keypoints import read_keypoints as read_keypoints
from kinefit.readers.markers import read_markers as read_markers
from kinefit.readers.motion import read_motion as read_motion
from kinefit.readers.skeletons.acclaim import read_amc as read_amc
from kinefit.readers.skeletons.bvh import read_bvh as read_bvh
from kinefit.simulation.retarget import retarget as retarget

# Errors, and rooms that `kinefit.` reaches without an import of their own
from kinefit import bodies as bodies, exporters as exporters, observations as observations, papers as papers
from kinefit import simulation as simulation
from kinefit.bodies import rendering as rendering
from kinefit.readers import assets as assets
from kinefit.simulation import evaluation as evaluation
from kinefit.solving import correspondences as correspondences
from kinefit.errors import KinefitError as KinefitError

__version__: str
