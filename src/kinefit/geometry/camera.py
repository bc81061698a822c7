"""Cameras (pinhole with lens distortion), rigs of cameras, and image frames that differ from the calibration's.

Pixels follow OpenCV: the centre of the first pixel is (0, 0). A camera looks along its z axis, x to the right, y down.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from kinefit._image_headers import MAX_IMAGE_PIXELS
from kinefit.errors import CalibrationError, check_choice, choices
from kinefit.geometry import _kernels_camera as kernels
from kinefit.geometry.se3 import inverse

MODELS = ("radtan", "fisheye")
_COEFFICIENT_COUNTS = {"radtan": (0, 4, 5, 8), "fisheye": (0, 4)}
_MAX_DISTORTION = 1e9  # of a coefficient; those of lenses are far smaller


def _read_only(array: ArrayLike) -> NDArray:
    out = np.array(array, dtype=float)
    out.flags.writeable = False
    return out


def _points(array: ArrayLike, columns: int) -> NDArray:
    out = np.asarray(array, dtype=float)
    if out.shape[-1:] != (columns,):
        raise CalibrationError(f"points have shape {out.shape}", remedy=f"Give (..., {columns}).")
    return out


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: intrinsics, lens distortion and pose.

    Parameters
    ----------
    name : str
    size : (width, height) [px]
        Of the image in which it was calibrated.
    matrix : (3, 3) [px]
        Focal lengths, skew and principal point, (0, 0) being the centre of the first pixel.
    distortion : (k,)
        "radtan": OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; "fisheye": OpenCV's k1 k2 k3 k4; empty for none.
    model : "radtan" or "fisheye"
    T_camera_world : (4, 4) [m]

    Raises
    ------
    CalibrationError
        A number that is not finite, a focal length that is not positive, or an invalid rotation.
    """

    name: str
    size: tuple[int, int]
    matrix: NDArray
    distortion: NDArray = ()  # type: ignore[assignment]
    model: str = "radtan"
    T_camera_world: NDArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        pose = np.eye(4) if self.T_camera_world is None else self.T_camera_world
        try:
            arrays = [_read_only(self.matrix), _read_only(np.ravel(self.distortion)), _read_only(pose)]
            size = (int(self.size[0]), int(self.size[1]))
        except (TypeError, ValueError, IndexError, OverflowError):
            raise self._error("its numbers cannot be read", "Give numbers, and the size as (width, height).") from None
        for field, value in zip(("matrix", "distortion", "T_camera_world", "size"), (*arrays, size)):
            object.__setattr__(self, field, value)
        self._check()

    def _error(self, problem: str, remedy: str) -> CalibrationError:
        return CalibrationError(problem, place=f"camera {self.name}", remedy=remedy)

    def _check(self) -> None:
        K, T, k = self.matrix, self.T_camera_world, self.distortion
        if self.model not in MODELS:
            raise self._error(choices("lens model", self.model, MODELS), "Convert the calibration to one of these.")
        if K.shape != (3, 3) or T.shape != (4, 4):
            raise self._error(f"matrix {K.shape}, pose {T.shape}", "Give (3, 3) and (4, 4).")
        if not all(np.isfinite(a).all() for a in (K, T, k)):
            raise self._error("a number is not finite", "Calibrate it again, or repair the file.")
        if min(self.size) < 1 or self.size[0] * self.size[1] > MAX_IMAGE_PIXELS:
            remedy = f"Give (width, height) in pixels; images have up to {MAX_IMAGE_PIXELS // 10**6} million pixels."
            raise self._error(f"image size {self.size}", remedy)
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise self._error(f"focal lengths {K[0, 0]:g}, {K[1, 1]:g} px", "Both must be positive.")
        if K[1, 0] != 0 or np.any(K[2] != (0, 0, 1)):
            raise self._error("matrix is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]]", "It may be transposed.")
        if k.size not in _COEFFICIENT_COUNTS[self.model]:
            raise self._error(
                f"{k.size} distortion coefficients for the model {self.model}",
                f"Give {', '.join(map(str, _COEFFICIENT_COUNTS[self.model]))} (no thin prism, no tilt).",
            )
        if np.abs(k).max(initial=0.0) > _MAX_DISTORTION:
            raise self._error(f"a distortion coefficient of {np.abs(k).max():.3g}", "Calibrate it again, or repair it.")
        R = T[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0 or np.any(T[3] != (0, 0, 0, 1)):
            raise self._error("rotation is not orthonormal and right-handed", "Give the rotation world to camera.")

    @cached_property
    def packed(self) -> NDArray:
        """The camera as an array (29,) for kernels; `_kernels_camera` describes its layout."""
        out = np.zeros(kernels.PACKED)
        K, T = self.matrix, self.T_camera_world
        out[kernels.MODEL] = MODELS.index(self.model)
        out[[kernels.FX, kernels.FY, kernels.CX, kernels.CY, kernels.SKEW]] = K[[0, 1, 0, 1, 0], [0, 1, 2, 2, 1]]
        out[kernels.DIST : kernels.DIST + self.distortion.size] = self.distortion
        out[kernels.ROT : kernels.ROT + 9] = T[:3, :3].ravel()
        out[kernels.TRANS : kernels.TRANS + 3] = T[:3, 3]
        out[[kernels.WIDTH, kernels.HEIGHT]] = self.size
        out[kernels.LIMIT] = _monotonic_limit(tuple(out[kernels.DIST : kernels.DIST + 8].tolist()), self.model)
        return _read_only(out)

    @property
    def T_world_camera(self) -> NDArray:
        """Pose (4, 4) [m] of the camera in the world."""
        return inverse(self.T_camera_world)

    @property
    def centre_world(self) -> NDArray:
        """Optical centre (3,) [m] in the world."""
        return -self.T_camera_world[:3, :3].T @ self.T_camera_world[:3, 3]

    def project(self, x_world: ArrayLike) -> NDArray:
        """Project points (N, 3) [m] of the world to pixels (N, 2) [px]; any leading axes.

        NaN behind the camera and where the distortion is not monotonic. Points outside of the image are projected too.
        """
        x = _points(x_world, 3)
        uv = np.empty((x.size // 3, 2))
        kernels.project_points(self.packed, np.array(x.reshape(-1, 3), order="C"), uv)
        return uv.reshape(*x.shape[:-1], 2)

    def project_with_jacobian(self, x_world: ArrayLike) -> tuple[NDArray, NDArray]:
        """Pixels (N, 2) [px] as of `project`, and their derivatives (N, 2, 3) [px/m] by the points (N, 3) [m]."""
        x = _points(x_world, 3)
        uv, jacobian = np.empty((x.size // 3, 2)), np.empty((x.size // 3, 2, 3))
        kernels.project_points_jacobian(self.packed, np.array(x.reshape(-1, 3), order="C"), uv, jacobian)
        return uv.reshape(*x.shape[:-1], 2), jacobian.reshape(*x.shape[:-1], 2, 3)

    def ray(self, uv: ArrayLike) -> NDArray:
        """Unit directions (N, 3) in the world of the rays through pixels (N, 2); NaN where there is none."""
        pixels = _points(uv, 2)
        directions = np.empty((pixels.size // 2, 3))
        kernels.rays(self.packed, np.array(pixels.reshape(-1, 2), order="C"), directions)
        return directions.reshape(*pixels.shape[:-1], 3)

    @cached_property
    def ray_table(self) -> NDArray:
        """x/z and y/z (2, H, W) of the ray through every pixel, in the camera's frame; NaN where there is none."""
        u, v = np.meshgrid(np.arange(self.size[0], dtype=float), np.arange(self.size[1], dtype=float))
        rays = self.ray(np.stack([u, v], axis=-1)) @ self.T_camera_world[:3, :3].T
        return _read_only(np.ascontiguousarray(np.moveaxis(rays[..., :2] / rays[..., 2:], -1, 0)))

    def with_pose(self, T_camera_world: ArrayLike) -> Camera:
        """The camera with another pose (4, 4) [m]."""
        return replace(self, T_camera_world=np.asarray(T_camera_world, float))

    def scaled(self, size: tuple[int, int]) -> Camera:
        """The camera with its whole image scaled to another size (width, height) [px]."""
        return replace(self, size=size, matrix=ImageFrame.scaled(self.size, size).T_image_calibration @ self.matrix)


@lru_cache(maxsize=256)  # a moving camera needs it at every pose
def _monotonic_limit(k: tuple[float, ...], model: str) -> float:
    """Largest r² (radtan) or θ [rad] (fisheye) up to which the radial distortion is monotonic, minus a small margin."""
    if model == "fisheye":
        derivative = Polynomial([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])
        return (1 - 1e-6) * min(np.pi, np.sqrt(_first_root(derivative)))
    q = Polynomial([0, 1])
    above, below = Polynomial([1, k[0], k[1], k[4]]), Polynomial([1, k[5], k[6], k[7]])
    derivative = (above + 2 * q * above.deriv()) * below - 2 * q * above * below.deriv()
    return (1 - 1e-6) * min(_first_root(derivative), _first_root(below))


def _first_root(polynomial: Polynomial) -> float:
    """Smallest positive root, infinite if there is none."""
    roots = polynomial.trim(1e-100).roots()  # smaller ones have no effect in any image
    real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
    return min((float(r) for r in real if r > 0), default=np.inf)


@dataclass(frozen=True, eq=False)
class ImageFrame:
    """Map between a delivered image and the image in which its camera was calibrated.

    Parameters
    ----------
    T_image_calibration : (3, 3)
        Homogeneous map of pixels, calibration's to delivered: scales, letterbox offset, quarter turns.
    """

    T_image_calibration: NDArray

    def __post_init__(self) -> None:
        try:
            T = _read_only(self.T_image_calibration)
        except (TypeError, ValueError):
            raise CalibrationError("no map of images", remedy="Give an invertible affine (3, 3) of pixels.") from None
        if T.shape != (3, 3) or not np.isfinite(T).all() or abs(np.linalg.det(T)) < 1e-12 or np.any(T[2] != (0, 0, 1)):
            raise CalibrationError("no map of images", remedy="Give an invertible affine (3, 3) of pixels.")
        object.__setattr__(self, "T_image_calibration", T)

    @classmethod
    def identity(cls) -> ImageFrame:
        """Frame of a delivered image that equals the calibration's."""
        return cls(np.eye(3))

    @classmethod
    def scaled(cls, calibration_size: tuple[int, int], image_size: tuple[int, int]) -> ImageFrame:
        """Frame of the whole image, stretched to another size (width, height) [px]."""
        sx, sy = _ratio(image_size, calibration_size)
        return cls(np.array([[sx, 0, 0.5 * (sx - 1)], [0, sy, 0.5 * (sy - 1)], [0, 0, 1]]))

    @classmethod
    def letterboxed(cls, calibration_size: tuple[int, int], image_size: tuple[int, int]) -> ImageFrame:
        """Frame of the whole image, scaled uniformly to fit another size (width, height) [px], centred between bars."""
        s = min(_ratio(image_size, calibration_size))
        offset = [0.5 * (image - s * calibrated) for image, calibrated in zip(image_size, calibration_size)]
        return cls(np.array([[s, 0, 0.5 * (s - 1) + offset[0]], [0, s, 0.5 * (s - 1) + offset[1]], [0, 0, 1]]))

    @classmethod
    def rotated(cls, calibration_size: tuple[int, int], degrees: int) -> ImageFrame:
        """Frame of the image rotated clockwise by 0, 90, 180 or 270 degrees; raises CalibrationError for others."""
        w, h = calibration_size[0] - 1.0, calibration_size[1] - 1.0
        turns = {
            0: np.eye(3),
            90: np.array([[0, -1, h], [1, 0, 0], [0, 0, 1]]),
            180: np.array([[-1, 0, w], [0, -1, h], [0, 0, 1]]),
            270: np.array([[0, 1, 0], [-1, 0, w], [0, 0, 1]]),
        }
        if degrees % 360 not in turns:
            raise CalibrationError(f"image turned by {degrees} degrees", remedy="Give 0, 90, 180 or 270.")
        return cls(turns[degrees % 360])

    def then(self, after: ImageFrame) -> ImageFrame:
        """Compose two frames: this change of the image, followed by another."""
        return ImageFrame(after.T_image_calibration @ self.T_image_calibration)

    @property
    def scale(self) -> tuple[float, float]:
        """Delivered pixels per pixel of the calibration, along its x and y; two numbers."""
        sx, sy = np.linalg.norm(self.T_image_calibration[:2, :2], axis=0)
        return float(sx), float(sy)

    def from_calibration(self, uv: ArrayLike) -> NDArray:
        """Map pixels (N, 2) from the calibration's image to the delivered one; any leading axes."""
        T = self.T_image_calibration
        return _points(uv, 2) @ T[:2, :2].T + T[:2, 2]

    def to_calibration(self, uv: ArrayLike) -> NDArray:
        """Map pixels (N, 2) from the delivered image to the calibration's; any leading axes."""
        T = self.T_image_calibration
        return (_points(uv, 2) - T[:2, 2]) @ np.linalg.inv(T[:2, :2]).T


def _ratio(size: tuple[int, int], of: tuple[int, int]) -> tuple[float, float]:
    if min(*size, *of) < 1:
        raise CalibrationError(f"image sizes {tuple(of)} and {tuple(size)}", remedy="Give (width, height) in pixels.")
    return size[0] / of[0], size[1] / of[1]



@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras in one world; `rig["cam01"]` is one of them. A take of markers alone has none: `Rig(())`.

    Raises
    ------
    CalibrationError
        Two cameras of one name, or an unknown name.
    """

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Sequence) or not all(isinstance(c, Camera) for c in self.cameras):
            problem = f"a rig of a {type(self.cameras).__name__} with entries that are not cameras"
            raise CalibrationError(problem, remedy="Give a tuple of Camera; read_calibration reads some from a file.")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        twice = [name for name in set(self.names) if self.names.count(name) > 1]
        if twice:
            raise CalibrationError("two cameras of one name", place=f"camera {twice[0]}", remedy="Rename one of them.")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(camera.name for camera in self.cameras)

    @cached_property
    def packed(self) -> NDArray:
        """The cameras as an array (C, 29) for kernels."""
        packed = np.array([camera.packed for camera in self.cameras], float)
        return _read_only(packed.reshape(len(self.cameras), kernels.PACKED))

    def project(self, x_world: NDArray, camera: NDArray) -> NDArray:
        """Project points (N, 3) [m], each by its camera (N,) int, to pixels (N, 2) [px]; NaN as in `Camera.project`."""
        uv = np.empty((len(x_world), 2))
        if len(self.cameras):
            kernels.project_each(self.packed, camera, np.array(x_world, float, order="C"), uv)
        return uv

    @property
    def distances(self) -> dict[tuple[str, str], float]:
        """Distances {(camera, camera): [m]} between the centres of all pairs."""
        return {
            (a.name, b.name): float(np.linalg.norm(a.centre_world - b.centre_world))
            for a, b in combinations(self.cameras, 2)
        }

    def index(self, name: str) -> int:
        """Index of a camera in the rig; raises CalibrationError for an unknown name."""
        check_choice("camera", name, self.names, CalibrationError, remedy="Use one of these names.")
        return self.names.index(name)

    def select(self, names: tuple[str, ...]) -> Rig:
        """Rig of some of the cameras, in the order given."""
        return Rig(tuple(self[name] for name in names))

    def with_camera(self, camera: Camera) -> Rig:
        """The rig with a camera in place of the one of its name."""
        return Rig(tuple(camera if c.name == camera.name else c for c in self.cameras))

    def moved(self, T_new_world: ArrayLike) -> Rig:
        """The rig in another world frame, T_new_world (4, 4) [m]."""
        T_world_new = inverse(np.asarray(T_new_world, float))
        return Rig(tuple(camera.with_pose(camera.T_camera_world @ T_world_new) for camera in self.cameras))

    def __getitem__(self, name: str) -> Camera:
        return self.cameras[self.index(name)]

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)
