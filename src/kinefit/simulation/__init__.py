"""Simulate known motions, and the data that sensors would record of them."""

from kinefit.simulation.figures import draw_figure, in_front
from kinefit.simulation.keypoints import simulate_keypoints, studio_rig
from kinefit.simulation.movements import Performer, movement, people, squat_and_wave
from kinefit.simulation.recordings import SENSORS, write_recording, write_synthetic_take
from kinefit.simulation.rendering.scenes import COLOUR, STEREO, ColourSensor, SimulatedScene, StereoSensor, picture
from kinefit.simulation.rendering.sensors import KINECT, TOF, DepthSensor, simulate_depth
from kinefit.simulation.retarget import cut, known_motion, on_body, resampled, retarget

__all__ = [
    "COLOUR",
    "KINECT",
    "SENSORS",
    "STEREO",
    "TOF",
    "ColourSensor",
    "DepthSensor",
    "Performer",
    "SimulatedScene",
    "StereoSensor",
    "cut",
    "draw_figure",
    "in_front",
    "known_motion",
    "movement",
    "on_body",
    "people",
    "picture",
    "resampled",
    "retarget",
    "simulate_depth",
    "simulate_keypoints",
    "squat_and_wave",
    "studio_rig",
    "write_recording",
    "write_synthetic_take",
]
