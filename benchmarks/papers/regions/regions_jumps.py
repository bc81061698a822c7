"""Jumps, fast turns, riders who rise from the saddle, and pedalling for seconds, at 100 Hz and blurred (P3 4).

The rendered scenes of `regions_gear`, at the paper's 100 Hz, by its four and seven cameras, with a shutter that is open
for half of the time between two images. The snowboarder's takes hold the jump and the turn in it: the rise of the
board and its fastest turn are printed, as true motion has them. The rider who stands is tracked without the saddle's
closure, which holds in every frame of a take where a body has it; what it costs to leave it is printed, too.

Figure 9 of the paper is a track without closures that becomes unstable after some frames of the cyclist. What
tracking without closures does here, by as many cameras, is printed for every take: frames beyond 50 mm.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.closures.closures_people import gap, left, own_circle, rms
from benchmarks.figures import LEFT_OUT, NotMeasured, amount, figure, quick
from benchmarks.papers.regions.gear_takes import GearTake, rendered_cyclist, rendered_snowboarder
from benchmarks.papers.regions.regions_gear import IMAGES, TRACKED, Followed, followed, outlined
from kinefit.geometry import se3
from kinefit.takes.track import track_take

SEEDS, RATE, SECONDS, JUMP_S = (11, 12), 100.0, 3.0, 1.4
CAMERAS = 4, 7
SIZE = 1.0  # of 640 × 480 px
SHUTTER = 0.5  # of the time between two images
RISES = 0.7, 2.3  # [s] in a take of `SECONDS`


def run() -> None:
    """Print the figures, and draw the jump and the rider who stands."""
    for cameras in amount(CAMERAS, CAMERAS[:1]):
        cyclists([cyclist(seed, cameras) for seed in amount(SEEDS, SEEDS[:1])], cameras)
    if quick():
        raise NotMeasured(LEFT_OUT)
    for cameras in CAMERAS:
        jumps([jump(seed, cameras) for seed in SEEDS], cameras)
    risers([riser(seed, CAMERAS[0]) for seed in SEEDS])


def cyclist(seed: int, cameras: int, *, seconds: float = SECONDS, size: float = SIZE) -> GearTake:
    """Somebody who pedals for seconds."""
    return rendered_cyclist(
        seed, seconds=seconds, videos=cameras, cameras=cameras, rate=RATE, shutter=SHUTTER, size=size
    )


def jump(seed: int, cameras: int) -> GearTake:
    """The snowboarder's jump with the turn in it."""
    return rendered_snowboarder(seed, seconds=JUMP_S, cameras=cameras, rate=RATE, size=SIZE, about_jump=True)


def riser(seed: int, cameras: int, *, seconds: float = SECONDS, size: float = SIZE) -> GearTake:
    """A rider who sits, stands and sits."""
    rise = (RISES[0] * seconds / SECONDS, RISES[1] * seconds / SECONDS)
    return rendered_cyclist(
        seed, seconds=seconds, videos=cameras, cameras=cameras, rate=RATE, shutter=SHUTTER, size=size, rise=rise
    )


def cyclists(takes: Sequence[GearTake], cameras: int) -> None:
    """Errors, the pedal's path, and what figure 9 of the paper shows."""
    found = [followed(take) for take in takes]
    begin = f"cyclist for seconds at 100 Hz, {cameras} cameras"
    _errors(begin, found)
    off = rms([own_circle(f.closed) for f in found])
    figure(f"{begin}: RMS of the cleats' paths from their circles", off, "mm", "<= 2")
    legs = np.concatenate([f.off(f.loose)[:, left(f.loose)].mean(axis=1) for f in found])
    share = 100.0 * float(np.mean(legs > TRACKED))
    print(f"  {begin}, without closures: left leg beyond {TRACKED:.0f} mm in {share:.1f} % of the frames")


def jumps(takes: Sequence[GearTake], cameras: int) -> None:
    """What is rendered, and its errors."""
    rises, turns = zip(*(motion_of(take) for take in takes))
    if cameras == CAMERAS[0]:
        figure("jump: rise of the board, least of the takes", 1e3 * min(rises), "mm", ">= 300")
        figure("jump: fastest turn of the board, least of the takes", float(np.degrees(min(turns))), "deg/s", ">= 90")
    found = [followed(take) for take in takes]
    begin = f"jump and turn at 100 Hz, {cameras} cameras"
    _errors(begin, found)
    figure(f"{begin}: boot to its binding, largest", max(float(gap(f.closed).max()) for f in found), "mm", "<= 2")
    if cameras == CAMERAS[-1]:
        picture(found[0], "regions_jump", [0.3, 0.5, 0.7])


def risers(takes: Sequence[GearTake]) -> None:
    """A rider who stands, without the closure of the saddle and with it."""
    found = [followed(take) for take in takes]
    _errors("rider who rises", found)
    kept = [seated(take) for take in takes]
    worse = float(np.mean([k.mean() for k in kept]) / np.mean([f.off(f.closed).mean() for f in found]))
    figure("rider who rises: mean joint error where the saddle's closure is left, over that", worse, "times", ">= 1")
    picture(found[0], "regions_rider_rises", [0.1, 0.5, 0.9])


def seated(take: GearTake) -> NDArray:
    """(F, S) [mm] errors of the joints where the saddle holds a rider who has left it."""
    with tempfile.TemporaryDirectory() as folder:
        motion = track_take(replace(take, without=()).write(Path(folder), closures=True))[0]
    return Followed(take, motion, motion).off(motion)


def motion_of(take: GearTake) -> tuple[float, float]:
    """[m] how far the board rises above its lowest place, and [rad/s] how fast it turns about the vertical at most."""
    T = take.truth.segment_poses()[:, take.truth.body.tree.segment("board")]
    turned = np.array([se3.log_so3(b @ a.T)[1] for a, b in zip(T[:-1, :3, :3], T[1:, :3, :3])])
    return float(np.ptp(T[:, 1, 3])), float(np.abs(turned).max() * take.truth.rate)


def _errors(begin: str, found: Sequence[Followed]) -> None:
    closed, loose = (np.concatenate([f.off(m) for f, m in pairs]) for pairs in (
        [(f, f.closed) for f in found], [(f, f.loose) for f in found]))  # fmt: skip
    figure(f"{begin}: mean joint error with closures", float(closed.mean()), "mm", "<= 20")
    tracked = 100.0 * float(np.mean(closed.mean(axis=1) <= TRACKED))
    figure(f"{begin}: frames tracked with closures", tracked, "% of frames", ">= 100")
    figure(f"{begin}: mean joint error without, over that with", float(loose.mean() / closed.mean()), "times", ">= 1")


def picture(f: Followed, name: str, shares: Sequence[float]) -> None:
    """Images of two cameras at some parts of the take, with the contour of the tracked body."""
    rows = []
    for camera in list(f.take.scene.rig)[:2]:
        rows.append(np.hstack([outlined(f, int(share * (len(f.take.scene) - 1)), camera, 1) for share in shares]))
    cv2.imwrite(str(IMAGES / f"{name}.jpg"), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])
