"""Every figure of markers: `python -m benchmarks.markers`; some parts: `python -m benchmarks.markers markers_fit`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "markers_synthetic": "the paper's synthetic test, for its method and for `identify`",
    "markers_sapm": "the paper's method on real takes, beside `identify`",
    "markers_real": "who is who in real takes, frame by frame and whole",
    "markers_unknown": "label sets that the catalogue does not know",
    "markers_robot": "a robot's markers: a tree and a set of one's own",
    "markers_audit": "models of subjects, and labels that somebody else gave",
    "markers_fit": "bodies and angles beside Plug-in-Gait's and OpenSim's",
    "markers_roads": "`kinefit markers fit` and `kinefit track` on the same files",
    "markers_jumps": "angles that jump from frame to frame, and whether their error bars say so",
    "markers_left_out": "error bars of real takes against markers that are left out",
    "body_trackers": "trackers on the body, made of real marker plates, against the fit to all markers",
    "markers_speed": "time of large sets, and of a whole take from points to angles",
}

if __name__ == "__main__":
    run_parts(PARTS)
