"""Every figure of video: `python -m benchmarks.video`; only some parts: `python -m benchmarks.video detect check`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "tracking": "keypoints of the real trial and of known motions -> motion",
    "check": "what is wrong with a recording",
    "calibrate": "calibration refined with the body's motion, and found from people alone",
    "board": "calibration from boards",
    "detect": "the built-in detector",
    "detect_quality": "its qualities: each camera predicted by the others",
    "hands_detect": "hands found, and seen alike by two cameras",
    "faces_detect": "faces found, and seen alike by four cameras",
    "hide_faces": "faces left open in images that leave the program",
    "smoothing": "whole takes at once",
    "error_bars": "truth within the error bars",
    "channels": "what is found of the errors of markers and of a range sensor",
    "posture": "hips, spine and pelvis: what the posture prior tells",
}

if __name__ == "__main__":
    run_parts(PARTS)
