"""Public names: Fits of frames, people and takes."""

from kinefit.fitting.frame.results import FrameResult as FrameResult
from kinefit.fitting.markers.subject import fit_marker_subject as fit_marker_subject
from kinefit.fitting.markers.subject import split_people as split_people
from kinefit.fitting.smoothing.online.fixed_lag import FixedLag as FixedLag
from kinefit.fitting.smoothing.online.fixed_lag import KnownNoise as KnownNoise
from kinefit.fitting.subject.fit import fit_subject as fit_subject
from kinefit.fitting.subject.subject import OwnUnknowns as OwnUnknowns
from kinefit.fitting.tracking.recording import Recording as Recording
from kinefit.fitting.tracking.tracker import Tracker as Tracker
from kinefit.fitting.tracking.video import fit_markers as fit_markers
from kinefit.fitting.tracking.video import track as track
