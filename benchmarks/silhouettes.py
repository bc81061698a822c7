"""Every figure of silhouettes: `python -m benchmarks.silhouettes`; some parts: `... silhouettes silhouettes_track`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "silhouettes_cga": "conformal geometric algebra",
    "silhouettes_morphing": "a morphing shoulder, rendered",
    "silhouettes_morphing_take": "the same shoulder by takes, every joint free",
    "silhouettes_shoulders": "the real trial with shoulders that morph and with stiff ones, in a camera held out",
    "silhouettes_collar_bones": "shoulders with joints of their own, rendered",
    "silhouettes_torso": "a man's torso into a woman's, with local morphs on top",
    "silhouettes_track": "the real trial by silhouettes alone",
    "silhouettes_anny": "the real trial on a realistic skin of the person's shape",
    "silhouettes_refined": "the realistic skin refined by accurate poses, and with morphs, in a camera held out",
    "silhouettes_speed": "time a frame; the renderer beside others",
    "silhouettes_basin": "from how far off a pose is found, with and without coarse to fine",
    "silhouettes_low_pass": "from how far off real poses are found, with low-pass surfaces and without",
    "silhouettes_car": "a car on a turntable",
    "silhouettes_cat": "a real toy by the silhouette of its colour",
    "silhouettes_contour": "pose of a closed 3D contour from an image's contour, real and rendered",
    "silhouettes_arm": "a real arm in two views",
}

if __name__ == "__main__":
    run_parts(PARTS)
