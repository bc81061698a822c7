"""Make the skin of a person in figures, `bodies/rendering/person_skin.npz`: `python -m benchmarks.person_skin`.

The humanoid's limbs get metaballs whose cross-sections follow the widths below, which are round figures of an average
adult set by hand, no other model's. One seamless skin with weights is meshed over all of them
(`kinefit.bodies.surfaces.skins.body_skin`). `kinefit.bodies.rendering.looks` scales it to a body's own lengths and
widths.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, load_body
from kinefit.bodies.rendering.looks import FILE
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.skins.body_skin import body_skins

_OVERLAP = 1.5  # radius of a ball along its limb, over the gap to the next one
_SEEN = 0.82  # of a ball's radius across the limb, where balls overlap like that

# Of each limb in its segment's frame [m]: axis, then places along it, the middle's two offsets across (in the order of
# the other axes), and half widths there.
LIMBS: dict[str, tuple[str, list[tuple[float, ...]]]] = {
    "pelvis": ("y", [(-0.075, 0.0, 0, 0.085, 0.150), (-0.02, -0.012, 0, 0.112, 0.168), (0.04, -0.006, 0, 0.108, 0.160),
                     (0.10, 0.0, 0, 0.100, 0.146)]),
    "abdomen": ("y", [(0.0, 0.030, 0, 0.098, 0.144), (0.05, 0.034, 0, 0.094, 0.138), (0.10, 0.037, 0, 0.096, 0.141),
                      (0.16, 0.040, 0, 0.103, 0.148)]),
    "thorax": ("y", [(0.0, 0.040, 0, 0.103, 0.148), (0.07, 0.040, 0, 0.112, 0.156), (0.14, 0.036, 0, 0.115, 0.164),
                     (0.20, 0.028, 0, 0.103, 0.160), (0.25, 0.016, 0, 0.084, 0.132), (0.29, 0.004, 0, 0.066, 0.082)]),
    "head": ("y", [(0.0, -0.004, 0, 0.062, 0.064), (0.04, 0.002, 0, 0.060, 0.058), (0.085, 0.018, 0, 0.084, 0.065),
                   (0.13, 0.026, 0, 0.100, 0.077), (0.175, 0.020, 0, 0.105, 0.082), (0.215, 0.014, 0, 0.096, 0.076)]),
    "clavicle": ("z", [(0.02, -0.006, 0, 0.062, 0.050), (0.09, -0.028, 0, 0.060, 0.052),
                      (0.15, -0.046, -0.004, 0.054, 0.047)]),
    "upperarm": ("-y", [(0.01, 0, 0, 0.055, 0.049), (0.07, 0, 0, 0.055, 0.052), (0.15, 0.003, 0, 0.050, 0.047),
                        (0.22, 0, 0, 0.043, 0.042), (0.29, 0, 0, 0.040, 0.041)]),
    "forearm": ("-y", [(0.0, 0, 0, 0.040, 0.042), (0.06, 0.003, 0, 0.043, 0.045), (0.13, 0, 0, 0.036, 0.040),
                       (0.20, 0, 0, 0.027, 0.033), (0.255, 0, 0, 0.022, 0.030)]),
    "hand": ("-y", [(0.0, 0, 0, 0.021, 0.030), (0.045, 0, 0, 0.020, 0.040), (0.09, 0, 0, 0.018, 0.043),
                    (0.135, 0, 0, 0.014, 0.038), (0.165, 0, 0, 0.011, 0.028)]),
    "thigh": ("-y", [(0.0, -0.004, 0, 0.092, 0.080), (0.08, 0.0, 0, 0.090, 0.082), (0.17, 0.004, 0, 0.083, 0.075),
                     (0.26, 0.003, 0, 0.073, 0.065), (0.34, 0.0, 0, 0.062, 0.056), (0.42, 0.0, 0, 0.057, 0.053)]),
    "shank": ("-y", [(0.0, 0, 0, 0.057, 0.052), (0.07, -0.007, 0, 0.058, 0.053), (0.14, -0.011, 0, 0.060, 0.055),
                     (0.22, -0.008, 0, 0.049, 0.046), (0.31, -0.004, 0, 0.037, 0.036),
                     (0.42, -0.004, 0, 0.036, 0.033)]),
    "foot": ("x", [(-0.040, -0.052, 0, 0.032, 0.031), (0.005, -0.042, 0.002, 0.042, 0.034),
                   (0.05, -0.050, 0.004, 0.034, 0.038), (0.095, -0.058, 0.008, 0.026, 0.043),
                   (0.13, -0.063, 0.010, 0.021, 0.045)]),
    "toes": ("x", [(0.0, -0.003, 0, 0.021, 0.045), (0.035, -0.006, 0, 0.017, 0.043), (0.065, -0.008, 0, 0.013, 0.034)]),
}  # fmt: skip


def limb(segment: int, axis: str, sections: list[tuple[float, ...]], mirrored: bool) -> Metaballs:
    """Metaballs of a segment with half widths about those of the sections."""
    at, first, second, half_first, half_second = np.array(sections, float).T
    along = "xyz".index(axis[-1])
    across = [k for k in range(3) if k != along]
    centres, radii = np.empty((2, len(at), 3))
    centres[:, along] = -at if axis.startswith("-") else at
    centres[:, across] = np.stack([first, second], axis=1)
    radii[:, along] = _OVERLAP * np.gradient(at)
    radii[:, across] = np.stack([half_first, half_second], axis=1) / _SEEN
    made = Metaballs.of(segment, centres, radii)
    return made.mirrored() if mirrored else made


def person() -> Body:
    """The humanoid with these metaballs."""
    body = load_body("humanoid")
    balls = []
    for s, name in enumerate(body.tree.segments):
        axis, sections = LIMBS[name.removesuffix("_r").removesuffix("_l")]
        balls.append(limb(s, axis, sections, name.endswith("_l")))
    return replace(body, surfaces=tuple(balls))


def skin(times: int = 0) -> dict[str, NDArray]:
    """Arrays of the file: vertices (V, 3) [m], faces (T, 3), owners (V, K), weights (V, K), segments."""
    body = person()
    (made,) = body_skins(body)
    x, faces, every = made.mesh(times)
    owners = np.argsort(-every, axis=1)[:, :4]
    weights = np.take_along_axis(every, owners, axis=1)
    return {
        "vertices": made.at_rest(x, every).astype(np.float32), "faces": faces.astype(np.uint16),
        "owners": np.where(weights > 0, owners, 0).astype(np.uint8), "weights": weights.astype(np.float32),
        "segments": np.array(body.tree.segments),
    }  # fmt: skip


if __name__ == "__main__":
    Path(FILE).parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, **skin())  # type: ignore[arg-type]
    print(f"{FILE}: {Path(FILE).stat().st_size / 1e3:.0f} kB")
