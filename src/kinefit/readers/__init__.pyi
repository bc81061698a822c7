"""Public names: Readers of files."""

from kinefit.readers.calibration.read import read_calibration as read_calibration
from kinefit.readers.calibration.read import write_calibration as write_calibration
from kinefit.readers.calibration.write import write_calibration_like as write_calibration_like
from kinefit.readers.depth.recordings import read_clouds as read_clouds
from kinefit.readers.depth.recordings import read_depth as read_depth
from kinefit.readers.landmarks.detections import read_detections as read_detections
from kinefit.readers.landmarks.keypoints import read_caliscope_csv as read_caliscope_csv
from kinefit.readers.landmarks.keypoints import read_keypoints as read_keypoints
from kinefit.readers.landmarks.networks import NetworkFormat as NetworkFormat
from kinefit.readers.landmarks.networks import PointLayout as PointLayout
from kinefit.readers.markers import read_markers as read_markers
from kinefit.readers.motion import read_motion as read_motion
from kinefit.readers.plugins import FileFormat as FileFormat
from kinefit.readers.skeletons.acclaim import read_amc as read_amc
from kinefit.readers.skeletons.bvh import read_bvh as read_bvh
from kinefit.readers.take.file import read_take as read_take
from kinefit.readers.take.kinds import Proposal as Proposal
from kinefit.readers.take.kinds import SensorKind as SensorKind
from kinefit.readers.take.kinds import TakeEntry as TakeEntry
from kinefit.readers.take.load import load_observations as load_observations
