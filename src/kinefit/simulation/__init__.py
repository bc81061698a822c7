"""A known motion, and what sensors would have seen of it."""

from kinefit.simulation.exercise import squat_and_wave
from kinefit.simulation.figures import draw_figure
from kinefit.simulation.keypoints import simulate_keypoints, studio_rig
from kinefit.simulation.retarget import cut, known_motion, resampled, retarget
from kinefit.simulation.takes import write_synthetic_take

__all__ = [
    "cut",
    "draw_figure",
    "known_motion",
    "resampled",
    "retarget",
    "simulate_keypoints",
    "squat_and_wave",
    "studio_rig",
    "write_synthetic_take",
]
