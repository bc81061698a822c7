"""Every figure of matching and surfaces: `python -m benchmarks.photogrammetry`; only some parts: `... dic lsm`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "bar": "cameras from a bar with two targets, drawn",
    "dic": "speckle images with known displacement and strain, beside pyvale",
    "dic_plates": "a rigid plate and a plate with a hole of pyvale's, one camera and two, beside pyvale",
    "lsm": "sub-pixel shifts and affinities of drawn texture, beside OpenCV",
    "stereo_cylinder": "a speckled cylinder before two cameras, in three positions",
    "surface_body": "a drawn textured arm through `kinefit surface` and `kinefit track`",
    "surface_return": "points of the same arm that vanish, found again where its motion says",
    "video_bodies": "drawn videos and a bar recording through the commands, with nothing but clicked joints",
    "metaballs": "an arm of metaballs fitted to points",
    "surface_arm": "a bare arm before two cameras, tracked",
    "surface_clothes": "skin and clothes of real people: followed in one camera, measured between two",
    "surface_sequences": "real textured images that move: points followed, said to be lost, wrong; bright spheres",
    "clicked": "poses from joints clicked in three images",
    "retarget": "recorded motions on other characters, in the Khronos validator",
}

if __name__ == "__main__":
    run_parts(PARTS)
