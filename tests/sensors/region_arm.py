"""An arm of three coloured parts, each an OBJ file, painted before a patterned wall, for tests of regions."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.rendering import render_body
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame

CAMERA = Camera("cam", (320, 240), [[420.0, 0, 159.5], [0, 420.0, 119.5], [0, 0, 1]])
RIG = Rig((CAMERA,))
COLOURS = np.array([(190, 60, 50), (60, 70, 170), (220, 180, 140)])
TOML = """
[body]
name = "arm"
stature = 0.6

[[segment]]
name = "base"
joint = { name = "free", type = "free" }
surface = { mesh = "base.obj" }

[[segment]]
name = "upper"
parent = "base"
joint = { name = "shoulder", type = "universal", at = [0.07, 0.0, 0.0], axes = ["z", "y"], spread = [60, 60] }
surface = { mesh = "upper.obj" }

[[segment]]
name = "fore"
parent = "upper"
joint = { name = "elbow", type = "revolute", at = [0.2, 0.0, 0.0], axes = ["y"], range = [[-150, 5]], spread = [60] }
surface = { mesh = "fore.obj" }
"""


def _tube(start, end, radius, around=14, along=10):
    """A closed tube along x with domes, (V, 3) and (T, 3)."""
    t = np.linspace(0.0, 1.0, along + 1)[1:-1]
    r = radius * (1 - np.abs(2 * t - 1) ** 4) ** 0.5
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.repeat((start + t * (end - start))[:, None], around, axis=1), np.outer(r, np.cos(a)),
                     np.outer(r, np.sin(a))], axis=-1).reshape(-1, 3)  # fmt: skip
    x = np.concatenate([[[start, 0, 0]], ring, [[end, 0, 0]]])
    n, top, faces = len(t), len(x) - 1, []
    for k in range(around):
        q = (k + 1) % around
        faces += [(0, 1 + q, 1 + k), (top, 1 + (n - 1) * around + k, 1 + (n - 1) * around + q)]
        for j in range(n - 1):
            b, c = 1 + j * around + k, 1 + j * around + q
            faces += [(b, c, c + around), (b, c + around, b + around)]
    return x, np.array(faces)


@cache
def arm():
    """As a user writes it: a TOML file with meshes beside it."""
    with tempfile.TemporaryDirectory() as folder:
        for name, tube in (("base", (-0.1, 0.1, 0.06)), ("upper", (-0.02, 0.22, 0.032)), ("fore", (-0.02, 0.2, 0.026))):
            x, faces = _tube(*tube)
            lines = [f"v {a:.6f} {b:.6f} {c:.6f}" for a, b, c in x] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
            (Path(folder) / f"{name}.obj").write_text("\n".join(lines))
        (Path(folder) / "arm.toml").write_text(TOML)
        return load_body(Path(folder) / "arm.toml")


def state(*angles):
    """A metre before the camera; angles [rad] of shoulder and elbow."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (-0.15, 0.0, 1.0)
    return BodyState(T, np.array(angles, float))


def image(truth, seed=0):
    """(240, 320, 3) uint8"""
    random = np.random.default_rng(seed)
    squares = (np.add.outer(np.arange(240) // 17, np.arange(320) // 23) % 2)[..., None]
    out = np.where(squares == 0, (90, 120, 90), (120, 130, 110)).astype(float)
    drawn = render_body(arm(), truth, CAMERA)
    out[drawn.seen] = COLOURS[drawn.segment[drawn.seen]]
    return np.clip(out + random.normal(0, 5, out.shape), 0, 255).astype(np.uint8)


def frame(truth, time=0.0, seed=0):
    """What the camera sees."""
    return ColourFrame("cam", time, image(truth, seed))
