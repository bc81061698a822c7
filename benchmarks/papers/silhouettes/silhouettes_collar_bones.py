"""Shoulders with joints of their own (P1 3.3): how much of the collar bones' angles silhouettes show, rendered.

`humanoid_shoulders` raises one shoulder by 20° and lowers the other, both come forward; three views and six, 9 frames.
The person is 4 % taller and 10 % thicker than the body of the catalogue. `kinefit track` has the body given (the
person's own), then fitted from the catalogue's; `[start]` states the first pose. Held out: two other people, whose
lengths differ by 4 % and girths by 8 % each for itself, sway in all joints before four and six cameras, 20 frames.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import figure
from benchmarks.papers.silhouettes.silhouettes_morphing_take import take_of_masks
from benchmarks.scenes.silhouettes_scene import ring, standing, swaying
from kinefit.bodies import Body, BodyState, load_body, save_body
from kinefit.bodies.motion import Motion
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


def person(body: Body, lengths: NDArray, girths: NDArray) -> Body:
    """Somebody else: lengths and girths (G,) of the scale groups, as shares of the body's."""
    large, group = body.scaled(lengths), body.segment_scale
    radii = [
        np.multiply(s.radii, girths[group[s.segment]]).tolist() if isinstance(s, TaperedCylinder) else None
        for s in large.surfaces
    ]
    return replace(large, surfaces=tuple(
        s if r is None else replace(s, radii=tuple(map(tuple, r))) for s, r in zip(large.surfaces, radii)
    ))  # fmt: skip


def tracked(somebody: Body, count: int, states: list[BodyState], body: Body | None) -> Motion:
    """The motion by silhouettes of so many views: of this body, fitted to the person, or of the person's own."""
    with tempfile.TemporaryDirectory() as work:
        save_body(somebody, Path(work) / "person.npz")
        head = 'body = "person.npz"\nsize = false' if body is None else f'body = "{body.name}"'
        return track_take(take_of_masks(Path(work), somebody, list(ring(count)), states, head))[0]


def held_out(body: Body, own: list[int]) -> None:
    """Print the share of angles within two stated standard deviations, of other people and motions."""
    ratios, errors, stated = [], [], []
    for seed, count in ((3, 4), (4, 6)):
        random, groups = np.random.default_rng(seed), len(body.scale_groups)
        lengths, girths = (np.exp(random.normal(0.0, spread, groups)) for spread in (0.04, 0.08))
        states = swaying(body, 20, period=20.0, seed=seed)
        motion = tracked(person(body, lengths, girths), count, states, body)
        errors.append(np.abs(motion.angles - [s.angles for s in states]))
        stated.append(motion.dof_std[:, 6:])
        ratios.append(errors[-1] / stated[-1])
    inside = np.concatenate(ratios) <= 2.0
    off, std = (np.degrees(np.concatenate(values)) for values in (errors, stated))
    print(f"#   held out: all angles {np.sqrt(np.square(off).mean()):.1f} deg RMS off, {np.median(std):.1f} stated; "
          f"collar bones {np.sqrt(np.square(off[:, own]).mean()):.1f} and {np.median(std[:, own]):.1f}")  # fmt: skip
    figure("collar_bones_held", 100.0 * float(inside[:, own].mean()), "% within two standard deviations", ">= 90")
    figure("collar_bones_all_held", 100.0 * float(inside.mean()), "% of all angles within two", ">= 90")


def run() -> None:
    """Print the mean error of the collar bones' four angles beside their mean size, and what the fit states."""
    body = load_body("humanoid_shoulders")
    own, groups = [body.tree.coordinate(name) for name in ENDS], len(body.scale_groups)
    somebody = person(body, np.full(groups, TALLER), np.full(groups, THICKER))
    states = [posture(somebody, i) for i in range(FRAMES)]
    size = float(np.mean(np.abs(list(ENDS.values()))))
    for count in (3, 6):
        plain = f"collar_bones_{count}_views_deg"
        for name, given in ((plain, None), (f"collar_bones_{count}_views_fitted_deg", body)):
            motion = tracked(somebody, count, states, given)
            off = np.degrees(motion.angles[-1] - states[-1].angles)[own]
            std = np.degrees(motion.dof_std[-1, 6:][own])
            print(f"#   {name}: errors {np.round(off, 1).tolist()} deg of {list(ENDS.values())}, stated standard "
                  f"deviations {np.round(std, 1).tolist()} deg, stature {motion.body.stature:.3f} of "
                  f"{somebody.stature:.3f} m", flush=True)  # fmt: skip
            figure(name, float(np.abs(off).mean()), f"deg mean, of {size:.0f} that they move", "<= 5")
    held_out(body, own)
