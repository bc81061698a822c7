"""Shoulders with joints of their own (P1 3.3): how much of the collar bones' angles silhouettes show, rendered.

`humanoid_shoulders` raises one shoulder by 20° and lowers the other, both come forward; three views and six, 9 frames.
The person is 4 % taller and 10 % thicker than the body of the catalogue. `kinefit track` has the body given (the
person's own), then fitted from the catalogue's; `[start]` states the first pose.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import figure
from benchmarks.papers.silhouettes.silhouettes_morphing_take import take_of_masks
from benchmarks.scenes.silhouettes_scene import ring, standing
from kinefit.bodies import Body, BodyState, load_body, save_body
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.takes.track import track_take

FRAMES = 9
ENDS = {"clav_elev_r": 20.0, "clav_prot_r": 12.0, "clav_elev_l": -8.0, "clav_prot_l": 16.0}  # [deg]
TALLER, THICKER = 1.04, 1.10


def posture(body: Body, i: int) -> BodyState:
    """Step i of FRAMES, one arm raised forward, one to the side."""
    angles = np.array(body.tree.usual)
    now = {name: end * i / (FRAMES - 1) for name, end in ENDS.items()}
    for name, degrees in {**now, "arm_flex_r": 40.0, "arm_add_l": -40.0}.items():
        angles[body.tree.coordinate(name)] = np.radians(degrees)
    return standing(body, angles)


def person(body: Body) -> Body:
    """Somebody else, of another size and other girths."""
    large = body.scaled(np.full(len(body.scale_groups), TALLER))
    radii = [np.multiply(s.radii, THICKER).tolist() if isinstance(s, TaperedCylinder) else None for s in large.surfaces]
    return replace(large, surfaces=tuple(
        s if r is None else replace(s, radii=tuple(map(tuple, r))) for s, r in zip(large.surfaces, radii)
    ))  # fmt: skip


def run() -> None:
    """Print the mean error of the collar bones' four angles beside their mean size, and what the fit states."""
    body = load_body("humanoid_shoulders")
    somebody, own = person(body), [body.tree.coordinate(name) for name in ENDS]
    states = [posture(somebody, i) for i in range(FRAMES)]
    size = float(np.mean(np.abs(list(ENDS.values()))))
    for count in (3, 6):
        plain = f"collar_bones_{count}_views_deg"
        for name, given in ((plain, True), (f"collar_bones_{count}_views_fitted_deg", False)):
            with tempfile.TemporaryDirectory() as work:
                save_body(somebody, Path(work) / "person.npz")
                head = 'body = "person.npz"\nsize = false' if given else f'body = "{body.name}"'
                motion = track_take(take_of_masks(Path(work), somebody, list(ring(count)), states, head))[0]
            off = np.degrees(motion.angles[-1] - states[-1].angles)[own]
            told = np.degrees(motion.dof_std[-1, 6:][own])
            print(f"#   {name}: errors {np.round(off, 1).tolist()} deg of {list(ENDS.values())}, stated standard "
                  f"deviations {np.round(told, 1).tolist()} deg, stature {motion.body.stature:.3f} of "
                  f"{somebody.stature:.3f} m", flush=True)  # fmt: skip
            figure(name, float(np.abs(off).mean()), f"deg mean, of {size:.0f} that they move", "<= 5")
