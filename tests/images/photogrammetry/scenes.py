"""Textured planes and cylinders before cameras, drawn from their formulas: truth for matching."""

import numpy as np

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.photogrammetry.spline_image import SplineImage


class Texture:
    """A sum of cosines over the plane, its grains `grain` wide."""

    def __init__(self, grain, seed=0, waves=120, contrast=40.0):
        rng = np.random.default_rng(seed)
        self.frequency = rng.normal(size=(waves, 2)) / (grain * np.sqrt(2))
        self.phase = rng.uniform(0, 2 * np.pi, waves)
        self.scale = contrast * np.sqrt(2 / waves)

    def __call__(self, x):
        """Grey values of places (N, 2)."""
        return 128 + self.scale * np.cos(x @ self.frequency.T + self.phase).sum(axis=1)


def pixels(size):
    """(H * W, 2) places of all pixels."""
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def pair(size=(160, 120), move=(0.0, 0.0), deform=((1.0, 0.0), (0.0, 1.0)), noise=0.0, seed=1, grain=1.5):
    """Two images; a place x of the first is at move + deform @ (x - middle) + middle of the second."""
    rng, texture = np.random.default_rng(seed), Texture(grain, seed)
    middle, at = np.array(size) / 2, pixels(size)
    back = (at - middle - move) @ np.linalg.inv(deform).T + middle
    out = [texture(x).reshape(size[::-1]) + noise * rng.normal(size=size[::-1]) for x in (at, back)]
    return [SplineImage.of(image) for image in out]


def camera(name, place, aim=(0.0, 0.0, 0.0), focal=420.0, size=(200, 150), distortion=(-0.05, 0.02, 0.0, 0.0)):
    """A camera at a place that looks at another, upright to -y."""
    place = np.array(place, float)
    z = (aim - place) / np.linalg.norm(aim - place)
    x = np.cross((0.0, 1.0, 0.0), z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = [[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]]
    return Camera(name, size, K, distortion, "radtan", se3.transform(R, -R @ place))


def three(apart=0.25):
    """Three cameras in a row, a metre from the origin."""
    return Rig(tuple(camera(name, (x, -0.1, -1.0)) for name, x in (("a", 0.0), ("b", apart), ("c", -apart))))


def plane_image(view, texture, T_world_plane=None, noise=0.0, rng=None):
    """What a camera sees of a plane z = 0 of its own frame."""
    T = np.eye(4) if T_world_plane is None else T_world_plane
    T_plane_world = se3.inverse(T)
    rays = view.ray(pixels(view.size)) @ T_plane_world[:3, :3].T
    origin = se3.apply(T_plane_world, view.centre_world)
    place = origin + rays * (-origin[2] / rays[:, 2])[:, None]
    grey = texture(place[:, :2]).reshape(view.size[::-1])
    if noise:
        grey = grey + noise * rng.normal(size=grey.shape)
    return SplineImage.of(grey)
