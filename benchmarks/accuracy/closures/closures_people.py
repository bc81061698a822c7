"""A cyclist and a snowboarder, simulated: keypoints of cameras with noise, drift, outliers, and a leg that nobody sees.

Settings are the catalogue's own, chosen on seeds 0 and 1; seeds 11 to 13 are printed. Bodies are tracked without a
start; lengths, and where the bike stands, are found in the same take. Without closures nothing holds the gear.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.accuracy.closures.closures_takes import Take, cyclist, snowboarder
from benchmarks.figures import amount, figure
from kinefit.bodies.motion import Motion
from kinefit.fitting.tracking.video import track

SEEDS = (11, 12, 13)
LEFT = ("shank_l", "foot_l", "toes_l")


def run() -> None:
    """Print the figures."""
    for name, make in (("cyclist", cyclist), ("snowboarder", snowboarder)):
        whole = [(take, *both(take)) for take in (make(seed) for seed in amount(SEEDS, SEEDS[:1]))]
        hidden = [(take, *both(take)) for take in (make(seed, leg=True) for seed in amount(SEEDS, SEEDS[:1]))]
        errors(name, whole, hidden)
        (pedals if name == "cyclist" else boots)(whole, hidden)
        bars(name, whole, hidden)


def both(take: Take) -> tuple[Motion, Motion]:
    """With closures and without."""
    generic = take.generic
    return track(take.recording, generic), track(take.recording, replace(generic, closures=(), dimensions=()))


def joints(motion: Motion) -> NDArray:
    """(F, S, 3) [m] joint centres of the person, gear left out."""
    body = motion.body
    person = ~body.gear_scale[body.segment_scale]
    return motion.segment_poses()[..., :3, 3][:, person]


def left(motion: Motion) -> list[int]:
    """Indices of the left leg beyond the hip among a person's joints."""
    body = motion.body
    person = np.flatnonzero(~body.gear_scale[body.segment_scale])
    return [int(np.flatnonzero(person == body.tree.segment(s))[0]) for s in LEFT]


def off(take: Take, motion: Motion) -> NDArray:
    """(F, S) [mm] error of the person's joint centres."""
    return 1e3 * np.linalg.norm(joints(motion) - joints(take.truth), axis=2)


def errors(name: str, whole, hidden) -> None:
    """Mean errors, and those of a leg that is not seen."""
    tracked = min(float(np.mean(m.quality > 0.0)) for _, m, _ in whole + hidden)
    figure(f"{name}: frames tracked", 100.0 * tracked, "%", ">= 100")
    closed, loose = (float(np.mean([off(t, m[k]).mean() for t, *m in whole])) for k in (0, 1))
    figure(f"{name}: mean joint error with closures", closed, "mm", "<= 20")
    print(f"  without closures: {loose:.1f} mm")
    closed, loose = (float(np.mean([off(t, m[k]).mean() for t, *m in hidden])) for k in (0, 1))
    figure(f"{name}, one leg hidden half of the time: mean joint error with closures", closed, "mm", "<= 20")
    print(f"  without closures: {loose:.1f} mm")
    closed, loose = (
        float(np.mean([off(t, m[k])[t.hidden][:, left(m[k])].mean() for t, *m in hidden])) for k in (0, 1)
    )
    print(f"  the hidden leg: {closed:.1f} mm with closures, {loose:.1f} mm without")
    figure(f"{name}, hidden leg: error with closures over that without", closed / loose, "of it", "<= 0.5")


def pedals(whole, hidden) -> None:
    """How far both cleats' paths are from circles."""
    for what, takes in (("pedal path", whole), ("pedal path, one leg hidden", hidden)):
        closed, loose = ([own_circle(m[k]) for _, *m in takes] for k in (0, 1))
        figure(f"cyclist, {what}: RMS deviation from its circle", rms(closed), "mm", "<= 2")
        print(f"  without closures: {rms(loose):.1f} mm, worst {max(float(c.max()) for c in loose):.1f} mm")


def rms(parts) -> float:
    """Of values in several arrays."""
    return float(np.sqrt(np.mean(np.square(np.concatenate([np.ravel(p) for p in parts])))))


def own_circle(motion: Motion) -> NDArray:
    """(F, 2) [mm] of both cleats from the circles that fit their paths best."""
    x = motion.positions(motion.body.landmarks.select(("r_cleat", "l_cleat")))
    out = []
    for path in np.moveaxis(x, 1, 0):
        middle = path.mean(axis=0)
        axes = np.linalg.svd(path - middle, full_matrices=False)[2]
        u, v, w = ((path - middle) @ axes.T).T
        fit = lambda c, u=u, v=v: np.hypot(u - c[0], v - c[1]) - c[2]
        found = least_squares(fit, [0.0, 0.0, 0.17]).x
        out.append(1e3 * np.hypot(fit(found), w))
    return np.stack(out, axis=1)


def boots(whole, hidden) -> None:
    """The left sole and its binding, of the gear as the right boot carries it."""
    for what, takes in (("boot to binding", whole), ("boot to binding, one leg hidden", hidden)):
        closed, loose = ([gap(m[k]) for _, *m in takes] for k in (0, 1))
        figure(f"snowboarder, {what}: largest distance", max(float(g.max()) for g in closed), "mm", "<= 2")
        print(f"  without closures: RMS {rms(loose):.1f} mm, largest {max(g.max() for g in loose):.1f}")


def gap(motion: Motion) -> NDArray:
    """(F,) [mm] from the left sole to its binding."""
    x = motion.positions(motion.body.landmarks.select(("l_sole", "left_binding")))
    return 1e3 * np.linalg.norm(x[:, 0] - x[:, 1], axis=1)


def bars(name: str, whole, hidden) -> None:
    """Whether error bars shrink, and cover."""
    for what, takes in (("", whole), (", one leg hidden", hidden)):
        inside = [cover(t, m[0]) for t, *m in takes]
        share = 100.0 * float(np.mean(np.concatenate(inside)))
        figure(f"{name}{what}: joint centres within 95 % error bars, at least", share, "%", ">= 90")
        figure(f"{name}{what}: joint centres within 95 % error bars, at most", share, "%", "<= 98")
        loose = 100.0 * float(np.mean(np.concatenate([cover(t, m[1]) for t, *m in takes])))
        closed_std, loose_std = (np.mean([foot_bar(m[k]) for _, *m in takes]) for k in (0, 1))
        print(f"  without closures: {loose:.1f} %")
        share = closed_std / loose_std
        figure(f"{name}{what}: error bar of the left foot, over that without closures", share, "of it", "<= 1")


def cover(take: Take, motion: Motion) -> NDArray:
    """Whether errors of joint centres, along each axis, are within 1.96 standard deviations; where these are finite."""
    body = motion.body
    std = motion.joint_std[:, ~body.gear_scale[body.segment_scale]]
    error, told = np.abs(joints(motion) - joints(take.truth)), np.isfinite(std)
    return error[told] <= 1.96 * std[told]


def foot_bar(motion: Motion) -> float:
    """[mm] mean error bar of the left foot, of frames in which it is finite."""
    std = motion.joint_std[:, motion.body.tree.segment("foot_l")]
    return 1e3 * float(np.mean(std[np.isfinite(std)]))
