"""Line drawings: the plan of a studio, markers that get their names."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from benchmarks.marker_takes import load
from numpy.typing import NDArray

from drawing import results
from kinefit import read_motion
from kinefit.bodies.rendering.looks import side_colour, to_hex
from kinefit.exporters import write_markers
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers

_TAKE = "mocaprecovery/data__85_12.c3d"  # a break dancer with 41 markers; CMU Graphics Lab
_PANEL = 300  # [px] width of one of the three


def studio() -> None:
    """The plan of the first recording: no two cameras face each other."""
    angles = np.radians([20.0, 105.0, 175.0, 265.0])
    facing = [abs(abs(np.degrees(b - a)) - 180.0) for a, b in combinations(angles, 2)]
    assert min(facing) > 15.0, "two cameras face each other"
    middle, far = np.array([320.0, 232.0]), np.array([250.0, 145.0])
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 460" font-family="system-ui, sans-serif"',
        ' font-size="14"><rect width="640" height="460" fill="#f7f9fb"/>',
        '<rect x="220" y="152" width="200" height="160" rx="8" fill="#e3ecf4" stroke="#9db4c8"',
        ' stroke-dasharray="6 4"/><text x="320" y="304" text-anchor="middle" fill="#37474f">volume, 2 m by 2 m</text>',
        '<ellipse cx="320" cy="232" rx="34" ry="16" fill="#93d08e" stroke="#37474f"/>',
        '<circle cx="320" cy="232" r="11" fill="#c9e8c6" stroke="#37474f"/>',
        '<path d="M320 216 l-7 -12 h14 z" fill="#37474f"/>',
    ]
    for k, angle in enumerate(angles, 1):
        at = middle + far * [np.cos(angle), np.sin(angle)]
        ahead = (middle - at) / np.linalg.norm(middle - at)
        aside = 0.42 * np.array([-ahead[1], ahead[0]])
        ends = [at + 330.0 * (ahead + s * aside) for s in (-1, 1)]
        path = " ".join(f"L{x:.0f} {y:.0f}" for x, y in ends)
        parts.append(f'<path d="M{at[0]:.0f} {at[1]:.0f} {path} Z" fill="#468cff" fill-opacity="0.07" stroke="#468cff" '
                     'stroke-opacity="0.4"/>')  # fmt: skip
        turn = np.degrees(np.arctan2(ahead[1], ahead[0]))
        parts.append('<rect x="-16" y="-9" width="26" height="18" rx="3" fill="#1d2733" '
                     f'transform="translate({at[0]:.0f} {at[1]:.0f}) rotate({turn:.0f})"/>')  # fmt: skip
        x, y = at - np.array([40.0, 24.0]) * ahead
        parts.append(f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle" fill="#37474f">cam{k:02d}</text>')
    parts.append('<text x="320" y="26" text-anchor="middle" fill="#1d2733" font-size="16">'
                 'seen from above: 3 to 4 m from the middle, none opposite another</text>')  # fmt: skip
    parts.append('<text x="320" y="446" text-anchor="middle" fill="#5b6875">'
                 "the person fills half of each image's height and never leaves it</text>")  # fmt: skip
    (results.IMAGES / "studio.svg").write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def markers() -> None:
    """Points of a frame as they come, the same with their names, and the body that was fitted to them."""
    out = results.folder("markers")
    taught, asked = load((_TAKE, 0.0, 0.45)), load((_TAKE, 0.55, 0.7))
    assert taught is not None and asked is not None
    write_markers(taught, out / "labelled.c3d")
    write_markers(Markers(tuple(f"*{k}" for k in range(len(asked.names))), asked.rate, asked.positions, up=asked.up),
                  out / "points.c3d")  # fmt: skip
    if not (out / "fitted" / "motion.npz").is_file():
        results.command("markers", "learn", out / "labelled.c3d", "--name", "anna", "-o", out / "anna.json")
        results.command("markers", "identify", out / "points.c3d", out / "anna.json", "-o", out / "points-named.c3d")
        results.command("markers", "fit", out / "points-named.c3d", "--formats", "motion", "-o", out / "fitted")
    named, motion = read_markers(out / "points-named.c3d"), read_motion(out / "fitted" / "motion.npz")
    up = "xyz".index(motion.up[-1])
    lying = int(np.argmin(np.nanmax(asked.positions[..., up], axis=1)))  # the frame that is nearest the floor
    R = _side_view(asked.positions[lying], up)
    flat = [x @ R.T for x in (asked.positions[lying], named.positions[lying], motion.segment_poses()[lying, :, :3, 3])]
    low, high = np.nanmin(flat[0], axis=0) - 0.12, np.nanmax(flat[0], axis=0) + 0.12
    scale = min(_PANEL / (high - low)[0], 290.0 / (high - low)[1])
    points, names, joints = (
        np.column_stack([
            (k + 0.5) * _PANEL + scale * (x[:, 0] - 0.5 * (low + high)[0]),
            185.0 - scale * (x[:, 1] - 0.5 * (low + high)[1]),
        ])
        for k, x in enumerate(flat)
    )  # fmt: skip
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {3 * _PANEL} 345" font-family="sans-serif">',
             '<rect width="100%" height="100%" fill="#fff"/>']  # fmt: skip
    for k, title in enumerate(("points.c3d", "points-named.c3d", "fitted body")):
        parts.append(f'<text x="{(k + 0.5) * _PANEL}" y="22" text-anchor="middle" font-size="14">{title}</text>')
    parts += [_dot(at, "#777") for at in points if np.isfinite(at).all()]
    for label, at in zip(named.names, names):
        name = label.rpartition(":")[2]
        if np.isfinite(at).all() and not name.startswith("*"):
            colour = to_hex(side_colour({"L": "_l", "R": "_r"}.get(name[0], "")))
            parts.append(_dot(at, colour))
            parts.append(f'<text x="{at[0] + 4:.1f}" y="{at[1] - 3:.1f}" font-size="8" fill="#333">{name}</text>')
    for segment, parent in enumerate(motion.body.tree.parents):
        if parent >= 0:
            (a, b), (c, d) = joints[parent], joints[segment]
            colour = to_hex(side_colour(motion.body.tree.segments[segment]))
            parts.append(f'<path d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" stroke="{colour}" stroke-width="7" '
                         'stroke-linecap="round"/>')  # fmt: skip
    parts += [_dot(at + [2 * _PANEL, 0.0], "#555", 1.6) for at in points if np.isfinite(at).all()]
    (results.IMAGES / "markers.svg").write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def _side_view(x: NDArray, up: int) -> NDArray:
    """(2, 3) axes of the image: the horizontal direction in which the points extend most, and up."""
    level = np.delete(np.arange(3), up)
    seen = x[np.isfinite(x).all(axis=1)][:, level]
    along = np.linalg.svd(seen - seen.mean(axis=0), full_matrices=False)[2][0]
    R = np.zeros((2, 3))
    R[0, level], R[1, up] = along, 1.0
    return R


def _dot(at: NDArray, colour: str, radius: float = 3.2) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}" fill="{colour}"/>'
