"""Depth images with the body's outlines."""

from dataclasses import replace

import numpy as np
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit.bodies.rendering.looks import LOST_COLOUR
from kinefit.exporters.pictures.overlay import depth_picture


def test_outlines_are_white_and_those_of_lost_segments_dashed_and_grey():
    motion, camera = smooth_motion(3, turns=0.1), a_camera("cam 0", 0.3)
    holes = np.zeros((camera.size[1], camera.size[0]))
    shown = []
    for quality in (np.ones_like(motion.segment_quality), np.zeros_like(motion.segment_quality)):
        picture = depth_picture(holes, replace(motion, segment_quality=quality), 1, camera)
        near = [np.abs(picture.astype(int) - colour).max(-1) < 30 for colour in ((255, 255, 255), LOST_COLOUR)]
        shown.append([int(there.sum()) for there in near])
    (white, none), (no_more, grey) = shown
    assert white > 500 and none == no_more == 0
    assert 0.25 * white < grey < 0.75 * white
