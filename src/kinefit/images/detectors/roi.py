"""Regions of interest: squares, turned upright with the person, that are cut out of a picture for a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

_MARGIN = 1.25  # of the published method: the square is that much larger than the circle around the person
_SLOWEST, _HURRY, _CHANGE = 0.01, 10.0, 1.0  # [Hz], [s], [Hz] of the filter, as published with the network
_STEP = 1 / 30  # [s] the rate they are meant for


@dataclass(frozen=True, eq=False)
class Roi:
    """A square in a picture.

    Parameters
    ----------
    centre : (2,) [px]
    side : float [px]
    turn : float [rad]
        Clockwise in the picture (u right, v down): 0 for a person upright, π/2 for one whose head is to the right.
    """

    centre: NDArray
    side: float
    turn: float

    @classmethod
    def around_person(cls, middle: ArrayLike, rim: ArrayLike) -> Roi:
        """Square around a person, given the middle of the hips and a point above it on the circle around all [px].

        Source: Bazarevsky et al., BlazePose: On-device real-time body pose tracking, 2020.
        """
        middle, rim = np.asarray(middle, float), np.asarray(rim, float)
        du, dv = rim - middle
        return cls(middle, 2 * _MARGIN * float(np.hypot(du, dv)), float(np.arctan2(du, -dv)))

    @classmethod
    def around_points(cls, points: NDArray, up: NDArray, sides: float) -> Roi:
        """Square of `sides` times the extent of points (N, 2) [px] around them, turned upright along `up` (2,)."""
        turn = float(np.arctan2(up[0], -up[1]))
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        turned = points @ R
        low, high = turned.min(axis=0), turned.max(axis=0)
        return cls(R @ (low + high) / 2, sides * float((high - low).max()), turn)

    def A_image_crop(self, size: int) -> NDArray:
        """(2, 3) map of the pixels of a crop of `size` px to those of the picture."""
        scale = self.side / size
        c, s = scale * np.cos(self.turn), scale * np.sin(self.turn)
        linear = np.array([[c, -s], [s, c]])
        return np.column_stack([linear, self.centre - linear @ [size / 2, size / 2]])

    def crop(self, image: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
        """The region as (size, size, 3) uint8; beyond the picture's rim its outermost pixels are repeated."""
        return cv2.warpAffine(
            image, self.A_image_crop(size), (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )

    def to_image(self, points_crop: NDArray, size: int) -> NDArray:
        """Points (..., 2) of the crop of `size` px in the picture [px]."""
        A = self.A_image_crop(size)
        return points_crop @ A[:, :2].T + A[:, 2]

    def to_upright(self, points_crop: NDArray) -> NDArray:
        """Points in space (..., 3), along the crop's u and v and away from the camera, along those of the picture."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        return points_crop @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T

    def corners(self) -> NDArray:
        """(4, 2) [px]."""
        return self.to_image(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), 1)


def is_inside(points: NDArray, shape: Sequence[int]) -> NDArray:
    """(...) bool, which points (..., 2) [px] lie in an image of a shape (H, W, ...)."""
    return np.asarray(((points > -0.5) & (points < np.array(shape[1::-1]) - 0.5)).all(axis=-1))


@dataclass(frozen=True, eq=False)
class Steady:
    """The two points of a region, steadied over time: a region that trembles makes the landmarks in it tremble.

    A low pass whose cutoff rises with the speed, so that it stands still with the person and follows without lag.
    Source: Casiez et al., 1€ filter, CHI 2012, with the constants published with BlazePose.

    Parameters
    ----------
    value, raw : (2, 2) [px]
        Middle and rim, filtered, and as they came last.
    speed : (2, 2) [1/s] in sides of the region
    """

    value: NDArray
    raw: NDArray
    speed: NDArray

    @classmethod
    def at(cls, points: NDArray) -> Steady:
        """Begin with the points as they are."""
        return cls(points, points, np.zeros_like(points))

    def follow(self, points: NDArray) -> Steady:
        """The points of the next picture."""
        radius = max(float(np.linalg.norm(points[1] - points[0])), 1e-6)
        speed = self.speed + _share(_CHANGE) * ((points - self.raw) / (2 * radius * _STEP) - self.speed)
        value = self.value + _share(_SLOWEST + _HURRY * np.abs(speed)) * (points - self.value)
        return Steady(value, points, speed)

    @property
    def roi(self) -> Roi:
        """The region."""
        return Roi.around_person(*self.value)


def _share(cutoff: ArrayLike) -> NDArray:
    """Weight of the new value in a low pass of the first order [Hz]."""
    turns = 2 * np.pi * _STEP * np.asarray(cutoff)
    return turns / (1 + turns)
