"""A cyclist and a snowboarder by the colours of rendered videos, with closures and without (P3 4, figures 9, 10, 12).

Each take is written as a user would have it and goes through `track_take`: `[[region]]` of every camera, keypoints of
the first frame alone, the catalogue's body, whose gear has no surfaces here: bike and board are in view and not
modelled. Lengths, girths and where the bike stands are found in the same take. Settings are the catalogue's and the
tracker's own; that the speed of gear lasts was found on seed 0, figures are of other seeds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.closures.closures_people import gap, joints, left, own_circle, rms
from benchmarks.figures import LEFT_OUT, ROOT, amount, figure, quick
from benchmarks.papers.regions.gear_takes import GearTake, rendered_cyclist, rendered_snowboarder
from benchmarks.scenes.curves import COLOURS, curves
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import Canvas, render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera
from kinefit.takes.track import track_take

SEEDS = (11, 12)
TRACKED = 50.0  # [mm] mean joint error of a frame up to which it counts as tracked
THRESHOLDS = (5, 10, 15, 20, 30, 40, 60, 80)  # [grey levels] of a plain subtraction; the best of them is told
MAKERS = {"cyclist": rendered_cyclist, "snowboarder": rendered_snowboarder}
IMAGES = ROOT / "docs" / "images"


@dataclass(frozen=True, eq=False)
class Followed:
    """A take with its motions with closures and without."""

    take: GearTake
    closed: Motion
    loose: Motion

    def off(self, motion: Motion) -> NDArray:
        """(F, S) [mm] error of the person's joint centres."""
        return 1e3 * np.linalg.norm(joints(motion) - joints(self.take.truth), axis=2)

    def leg(self, motion: Motion) -> float:
        """[mm] mean error of the left leg's joints in frames in which a cover hides it."""
        return float(self.off(motion)[self.take.hidden][:, left(motion)].mean())


def run() -> None:
    """Print the figures, and draw curves and pictures; the quick form is a fifth of a second of the cyclist alone."""
    for name, make in MAKERS.items():
        if quick() and name == "snowboarder":
            for part, goal in (("joints", "<= 20"), ("tracked", ">= 100"), ("hidden_leg", "<= 0.5"), ("boot", "<= 2")):
                figure(f"{name}_regions_{part}", None, "", goal, LEFT_OUT)
            continue
        whole = [followed(make(seed)) for seed in amount(SEEDS, SEEDS[:1])]
        hidden = [followed(make(seed, cover=True)) for seed in amount(SEEDS, ())]
        errors(name, whole, hidden)
        if name == "cyclist":
            pedals(whole, hidden)
        else:
            boots(whole, hidden)
            subtraction(whole[0])
        if not quick():
            picture(whole[0], hidden[0])
            (circles if name == "cyclist" else distances)(whole[0], hidden[0])


def followed(take: GearTake) -> Followed:
    """Written, and tracked."""
    with tempfile.TemporaryDirectory() as folder:
        closed, loose = (track_take(take.write(Path(folder), closures=c))[0] for c in (True, False))
    out = Followed(take, closed, loose)
    told = [out.off(m).mean(axis=1) for m in (closed, loose)]
    covered = ", leg hidden" if take.hidden.any() else ""
    print(f"  {take.name}, seed {take.seed}{covered}: joints {told[0].mean():.1f} mm, "
          f"worst frame {told[0].max():.1f}; without closures {told[1].mean():.1f}, {told[1].max():.1f}", flush=True)
    return out


def errors(name: str, whole: Sequence[Followed], hidden: Sequence[Followed]) -> None:
    """Mean errors, frames tracked, and a leg that nobody sees."""
    for key, takes in _kinds(whole, hidden):
        closed, loose = (np.concatenate([f.off(m) for f, m in pairs]) for pairs in (
            [(f, f.closed) for f in takes], [(f, f.loose) for f in takes]))  # fmt: skip
        figure(f"{name}_regions{key}_joints", float(closed.mean()), "mm", "<= 20")
        right = [100.0 * float(np.mean(e.mean(axis=1) <= TRACKED)) for e in (closed, loose)]
        figure(f"{name}_regions{key}_tracked", right[0], "% of frames", ">= 100")
        print(f"  without closures: {loose.mean():.1f} mm, {right[1]:.1f} % of frames")
    if not hidden:
        return
    closed, loose = (float(np.mean([f.leg(m) for f, m in pairs])) for pairs in (
        [(f, f.closed) for f in hidden], [(f, f.loose) for f in hidden]))  # fmt: skip
    figure(f"{name}_regions_hidden_leg", closed / loose, "of that without closures", "<= 0.5")
    print(f"  the hidden leg: {closed:.1f} mm with closures, {loose:.1f} mm without")


def _kinds(whole: Sequence[Followed], hidden: Sequence[Followed]) -> list[tuple[str, Sequence[Followed]]]:
    """Takes with their part of a figure's name; none of a kind that was left out."""
    return [(key, takes) for key, takes in (("", whole), ("_covered", hidden)) if takes]


def pedals(whole: Sequence[Followed], hidden: Sequence[Followed]) -> None:
    """How far both cleats' paths are from circles."""
    for key, takes in _kinds(whole, hidden):
        figure(f"cyclist_regions{key}_pedal", rms([own_circle(f.closed) for f in takes]), "mm RMS", "<= 2")
        print(f"  without closures: {rms([own_circle(f.loose) for f in takes]):.1f} mm")


def boots(whole: Sequence[Followed], hidden: Sequence[Followed]) -> None:
    """The left sole and its binding, of the board as the right boot carries it."""
    for key, takes in _kinds(whole, hidden):
        figure(f"snowboarder_regions{key}_boot", max(float(gap(f.closed).max()) for f in takes), "mm", "<= 2")
        loose = [gap(f.loose) for f in takes]
        print(f"  without closures: RMS {rms(loose):.1f} mm, largest {max(float(g.max()) for g in loose):.1f} mm")


def subtraction(f: Followed) -> None:
    """Overlap of plain subtraction with the true silhouette of rider and board."""
    scene, chosen = f.take.scene, range(0, len(f.take.scene), amount(8, 3))
    count = len(f.take.truth.body.tree.segments)
    plain = {t: list[float]() for t in THRESHOLDS}
    for camera in scene.rig:
        empty, canvas = scene.empty(camera), Canvas(camera.size)
        for i, image in zip(chosen, scene.images(camera, chosen)):
            mesh = scene.moving.mesh
            raster = canvas.draw_for(camera, scene.moving.posed(i), mesh.faces, cull=True, labels=mesh.face_segment)
            rider = raster.seen & (raster.segment < count)
            away = np.abs(image.astype(int) - empty).max(axis=2)
            for t in THRESHOLDS:
                plain[t].append(_iou(_largest(away > t), rider))
    best = max(THRESHOLDS, key=lambda t: np.mean(plain[t]))
    figure("snowboarder_subtraction_iou", float(np.mean(plain[best])), "", "<= 0.7")


def _largest(mask: NDArray) -> NDArray:
    """The largest piece of a mask, specks left out."""
    clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(clean)
    return labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if len(stats) > 1 else mask


def _iou(a: NDArray, b: NDArray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def drawn(motion: Motion, frame: int, camera: Camera) -> NDArray:
    return np.array(render_body(motion.body, motion.state(frame), camera, mesh=body_mesh(motion.body)).seen)


def outlined(f: Followed, frame: int, camera: Camera, width: int) -> NDArray:
    """An image (H, W, 3) BGR with the contour of the tracked body, so many pixels wide."""
    image = next(iter(f.take.scene.images(camera, [frame])))
    seen = drawn(f.closed, frame, camera).astype(np.uint8)
    lines, _ = cv2.findContours(seen, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(np.ascontiguousarray(image[..., ::-1]), lines, -1, (0, 255, 255), width))


def picture(whole: Followed, hidden: Followed) -> None:
    """Images of two cameras with the outline of the tracked body, for the docs."""
    rows = []
    for f in (whole, hidden):
        frame = 3 * len(f.take.scene) // 4
        row = []
        for camera in list(f.take.scene.rig)[:3]:
            row.append(outlined(f, frame, camera, 2))
        rows.append(np.hstack(row))
    shown = cv2.resize(np.vstack(rows), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / f"regions_{whole.take.name}.jpg"), shown, [cv2.IMWRITE_JPEG_QUALITY, 82])


def _paths(f: Followed) -> list[tuple[str, NDArray, str]]:
    """Ways (F, 3) [m] of the left ankle: true, with closures, without."""
    k = f.take.truth.body.tree.segment("foot_l")
    return [(style, m.segment_poses()[:, k, :3, 3], colour) for m, style, colour in (
        (f.take.truth, "", "#555"), (f.closed, "", COLOURS[0]), (f.loose, "4 3", COLOURS[1]))]  # fmt: skip


LEGEND = {"true": "#555", "with closures": COLOURS[0], "without": f"{COLOURS[1]} 4 3"}


def circles(whole: Followed, hidden: Followed) -> None:
    """The left ankle as seen along the crank's axis (figure 10 of P3)."""
    panels = []
    for title, f in (("cyclist, left ankle", whole), ("left leg hidden", hidden)):
        R = f.take.truth.segment_poses()[0, f.take.truth.body.tree.segment("bike"), :3, :3]
        lines = [((x @ R)[:, 0], (x @ R)[:, 1], colour, style) for style, x, colour in _paths(f)]
        panels.append((title, lines))
    curves(IMAGES / "regions_cyclist.svg", panels, x="along the bike [m]", y="up [m]", legend=LEGEND)


def distances(whole: Followed, hidden: Followed) -> None:
    """From the left boot to its binding over time (figure 12 of P3), and the way of the left ankle (figure 10)."""
    t = whole.take.truth.times
    lines = [(t, gap(m), c, s) for m, c, s in ((whole.closed, COLOURS[0], ""), (whole.loose, COLOURS[1], "4 3"))]
    more = [(t, gap(m), c, s) for m, c, s in ((hidden.closed, COLOURS[0], ""), (hidden.loose, COLOURS[1], "4 3"))]
    panels = [("boot to binding [mm]", lines), ("left leg hidden [mm]", more)]
    curves(IMAGES / "regions_snowboarder.svg", panels, x="time [s]", y="distance [mm]", legend=LEGEND)
    panels = [(f"left ankle, {axis} [m]", [(t, x[:, k], c, s) for s, x, c in _paths(whole)])
              for k, axis in ((2, "along"), (1, "up"))]  # fmt: skip
    curves(IMAGES / "regions_snowboarder_feet.svg", panels, x="time [s]", y="place [m]", legend=LEGEND)
