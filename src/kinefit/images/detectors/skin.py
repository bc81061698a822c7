"""Track face and hands by skin colour: a 2D tracker that learns the colour from a face and adapts it to the light.

Skin is classified by its histogram over chromaticity (a and b of Lab) against that of the rest of the image, as in
Argyros & Lourakis (ECCV 2004). Hands are the patches of skin that are near the predicted positions, and that move.
`detection` estimates more, with networks; this module needs none once the face is given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import rgb_image
from kinefit.errors import ObservationError
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.following import Follower
from kinefit.observations import KeypointFrame

FACE, LEFT_HAND, RIGHT_HAND = 0, 1, 2
LANDMARKS = ("nose_tip", "l_metacarpal_phalanx_3", "r_metacarpal_phalanx_3")  # at the centres of the patches
WRISTS = ("nose_tip", "l_wrist", "r_wrist")  # for bodies without fingers; the centre of a hand lies 8 cm further

_BINS = 64  # of a and of b
_PRIOR = 0.1  # probability of skin at a pixel
_MAX_SIDE_PX = 320  # of the image that is searched: a hand of a whole person is then some 8 px wide
_HAND_LENGTH = 0.8  # [heights of the face] (0.19 m to 0.24 m)
_MIN_AREA = 0.06  # [squares of the face's height] of a patch: a fist seen from the side has 0.1
_MIN_PIXELS = 6  # of a patch, so that it has a size and a direction
_MAX_CANDIDATES = 8  # for the hands
_MAX_HAND_LENGTHS = 1.3  # of a patch: longer ones are bare forearms with a hand at one end
_MAX_TIME_LOST = 0.5  # [s] for which an unobserved hand is predicted
_COLOUR_TIME = 2.0  # [s] time constant of the learnt colours: the light may change
_MOTION_TIME = 1.0  # [s] time constant of the motion at a pixel
_MOTION_THRESHOLD = 10  # [grey levels] difference between images of a pixel that moves: above a webcam's noise
_NO_HAND_SCORE = 0.6  # of "no hand": below a hand at its prediction, above a patch elsewhere that is at rest
_MAX_FACE_SQUARE = 16.0  # Mahalanobis distance squared of the face after a bow, from one image to the next
_FACE_RADIUS = 0.8  # [heights of the face] from its centre to its corners, and to the neck
_ARM_REACH = 5.5  # [heights of the face] arm and half the shoulders' width; faces are detected a fifth too small
_MIN_TRACKED_CONFIDENCE = 0.8  # of a tracked patch: it is observed (see `sensors.occlusion`), no guess
_FIRST_SHARE = 0.3  # of the first colour in the learnt one, which limits its drift


@dataclass(frozen=True, eq=False)
class SkinPatch:
    """A patch of skin: centre (2,) [px], covariance (2, 2) [px²], velocity (2,) [px/s], confidence, time unseen [s]."""

    centre: NDArray
    covariance: NDArray
    velocity: NDArray
    confidence: float
    unseen: float = 0.0


@dataclass(frozen=True, eq=False)
class _Patch:
    """Connected pixels: centre (2,), covariance (2, 2), number, share that moves, label, whether next to the face."""

    centre: NDArray
    covariance: NDArray
    size: int
    movement: float
    label: int
    crowded: bool

    @classmethod
    def of(cls, pixels: NDArray, movement: float, label: int, crowded: bool) -> _Patch:
        spread = np.cov(pixels.T) + 0.5 * np.eye(2)
        return cls(pixels.mean(axis=0), spread, len(pixels), movement, label, crowded)


class SkinTracker:
    """Tracks face and hands of one person in one camera.

    Left and right are the person's. When a hand comes into view, the person must face the camera with arms not crossed;
    later they may cross. The hand of a bare forearm is the end that moves more.

    Parameters
    ----------
    image : (H, W, 3) uint8 RGB, the first image
    face : (left, top, width, height) [px] of the face in it, from hair to chin; see `find_face`.
    rate : float [Hz]

    Raises
    ------
    ObservationError
        No colour image, a face outside of it, or a rate that is not positive.
    """

    def __init__(self, image: NDArray, face: tuple[float, float, float, float], *, rate: float = 30.0) -> None:
        self._check(image)
        left, top, width, height = (float(v) for v in face)
        h, w = image.shape[:2]
        is_inside = left < w and top < h and left + width > 0 and top + height > 0
        if not (min(width, height) >= 8 and width <= 2 * w and height <= 2 * h and is_inside):
            remedy = "Give (left, top, width, height) in pixels: 8 px or more, no larger than the image."
            raise ObservationError(f"no face at {tuple(face)} in an image of {w}x{h} px", remedy=remedy)
        if not rate > 0:
            raise ObservationError(f"a rate of {rate} Hz", remedy="Give images per second.")
        self._shape, self._step = image.shape, 1.0 / rate
        self._scale = min(1.0, _MAX_SIDE_PX / max(h, w))
        self._height = height * self._scale  # of the face, in the scaled image
        self._min_area = max(_MIN_AREA * self._height**2, _MIN_PIXELS)
        centre = self._scale * np.array([left + 0.5 * width, top + 0.5 * height])
        spread = np.diag([0.25 * width * self._scale, 0.25 * height * self._scale]) ** 2
        self.blobs: list[SkinPatch | None] = [SkinPatch(centre, spread, np.zeros(2), 1.0), None, None]
        self._grey: NDArray | None = None
        bins = self._chroma(image)
        self._motion = np.zeros(bins.shape, np.float32)
        v, u = np.mgrid[: bins.shape[0], : bins.shape[1]]
        from_face = np.sqrt(_squares(np.stack([u, v], -1).reshape(-1, 2), centre, spread)).reshape(bins.shape)
        self._first = self._skin = _histogram(bins[from_face < 1.2])  # without hair, ears and background
        self._rest = _histogram(bins[from_face > 3.0])

    def _check(self, image: NDArray) -> None:
        rgb_image(image)

    def _chroma(self, image: NDArray) -> NDArray:
        """Colour bins (h, w) of the scaled image; updates the motion of its pixels."""
        size = (round(image.shape[1] * self._scale), round(image.shape[0] * self._scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        if self._grey is not None:
            share = 1.0 - float(np.exp(-self._step / _MOTION_TIME))
            moves = (cv2.absdiff(grey, self._grey) > _MOTION_THRESHOLD).astype(np.float32)
            self._motion = (1.0 - share) * self._motion + share * moves
        self._grey = grey
        lab = cv2.cvtColor(small.astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab)
        fine = np.clip((lab[..., 1:] + 48.0) * (_BINS / 96.0), 0, _BINS - 1).astype(np.int64)
        return np.asarray(fine[..., 0] * _BINS + fine[..., 1])

    def update(self, image: NDArray) -> tuple[SkinPatch | None, SkinPatch | None, SkinPatch | None]:
        """Track face, left and right hand in the next image (H, W, 3) uint8; None for one not detected in it.

        Raises
        ------
        ObservationError
            No colour image, or one of another size than the first.
        """
        self._check(image)
        if image.shape != self._shape:
            problem = f"an image of shape {image.shape} after one of {self._shape}"
            raise ObservationError(problem, remedy="Start a new tracker for another camera.")
        bins = self._chroma(image)
        p = (self._skin * _PRIOR / (self._skin * _PRIOR + self._rest * (1.0 - _PRIOR)))[bins].astype(np.float32)
        p = cv2.GaussianBlur(p, (0, 0), max(0.03 * self._height, 0.5))
        mask = (p > 0.5).astype(np.uint8)
        self._predict()
        self._update_face(mask)
        self._update_hands(self._candidates(mask))
        self._learn(bins, mask > 0)
        return tuple(self._to_image(b) for b in self.blobs)  # type: ignore[return-value]

    def frame(self, sensor: str, time: float, names: tuple[str, str, str] = LANDMARKS) -> KeypointFrame:
        """Last detections as keypoints (3, 2) [px] of a sensor at a time [s]; NaN and confidence 0 if not detected."""
        blobs = [self._to_image(b) for b in self.blobs]
        uv = np.array([b.centre if b else (np.nan, np.nan) for b in blobs])
        return KeypointFrame(sensor, time, names, uv, np.array([b.confidence if b else 0.0 for b in blobs]))

    def _to_image(self, b: SkinPatch | None) -> SkinPatch | None:
        if b is None or b.unseen > 0.0:
            return None
        s = 1.0 / self._scale
        return replace(b, centre=(b.centre + 0.5) * s - 0.5, covariance=b.covariance * s**2, velocity=b.velocity * s)

    def _predict(self) -> None:
        for k, b in enumerate(self.blobs):
            if b is not None:
                unseen = b.unseen + self._step
                speed = 0.7 * b.velocity  # hands reverse their motion more often than not
                moved = replace(b, centre=b.centre + self._step * speed, velocity=speed, unseen=unseen, confidence=0.0)
                self.blobs[k] = moved if unseen <= _MAX_TIME_LOST or k == FACE else None

    def _update_face(self, mask: NDArray) -> None:
        """Update the face with the skin inside its predicted ellipse, slightly enlarged."""
        face = self.blobs[FACE]
        assert face is not None
        v, u = np.nonzero(mask)
        pixels = np.stack([u, v], axis=-1).astype(float)
        far = _squares(pixels, face.centre, face.covariance + np.eye(2) * (0.1 * self._height) ** 2)
        for reach in (4.0, _MAX_FACE_SQUARE):
            if (far < reach).sum() > self._min_area:
                self._update(FACE, _Patch.of(pixels[far < reach], 0.0, -1, False))
                return

    def _hand_near(self, patch: _Patch) -> bool:
        """Whether a hand is predicted near a patch adjacent to the face; else the patch is forehead or neck."""
        hands = [b for b in self.blobs[LEFT_HAND:] if b is not None]
        return any(np.linalg.norm(b.centre - patch.centre) < _FACE_RADIUS * self._height for b in hands)

    def _candidates(self, mask: NDArray) -> list[_Patch]:
        """Candidates for hands: patches of skin outside of the face, and both ends of long ones."""
        face, height = self.blobs[FACE], self._height
        assert face is not None
        v, u = np.nonzero(mask)
        pixels = np.stack([u, v], axis=-1).astype(float)
        inside = _squares(pixels, face.centre, face.covariance) < 5.0
        outside = mask.copy()
        outside[v[inside], u[inside]] = 0
        face_boundary = cv2.dilate(mask - outside, np.ones((3, 3), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=8)
        out = []
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] < self._min_area:
                continue
            rows, columns = np.nonzero(labels == k)
            crowded = bool(face_boundary[rows, columns].any())
            patch = np.stack([columns, rows], axis=-1).astype(float)
            for part in (p for p in _ends(patch, _HAND_LENGTH * height) if len(p) >= _MIN_PIXELS):
                x, y = part.astype(int).T
                candidate = _Patch.of(part, float(self._motion[y, x].mean()), k, crowded)
                away = float(np.linalg.norm(candidate.centre - face.centre))
                is_face = crowded and away < _FACE_RADIUS * height and not self._hand_near(candidate)
                if away < _ARM_REACH * height and not is_face:
                    out.append(candidate)
        return out

    def _update_hands(self, found: list[_Patch]) -> None:
        """Assign each hand a patch or none: the pair with the highest score (see `_score`)."""
        motion = max([0.1, *(p.movement for p in found)])
        sides_of_hands = LEFT_HAND, RIGHT_HAND
        found = sorted(found, key=lambda p: -max(self._score(k, p, motion) for k in sides_of_hands))[:_MAX_CANDIDATES]
        options: list[_Patch | None] = [None, *found]
        chosen, best = (options[0], options[0]), 2.0 * _NO_HAND_SCORE
        for left in options:
            for right in options:
                if left and right and left.label == right.label:
                    continue  # both ends of one arm
                sides = 0.3 if left and right and left.centre[0] > right.centre[0] else 0.0
                score = self._score(LEFT_HAND, left, motion) + self._score(RIGHT_HAND, right, motion) + sides
                if score > best:
                    chosen, best = (left, right), score
        for k, patch in zip((LEFT_HAND, RIGHT_HAND), chosen):
            if patch is not None:
                self._update(k, patch)

    def _score(self, k: int, patch: _Patch | None, motion: float) -> float:
        """Score of a patch as hand k: proximity to the prediction (0..1) and motion (0..2).

        Hands move more than wood, carpets and forearms, which have similar colours. A hand at rest keeps its patch.
        """
        if patch is None:
            return _NO_HAND_SCORE
        hand, face = self.blobs[k], self.blobs[FACE]
        assert face is not None
        motion_score = 2.0 * patch.movement / motion
        if hand is None:
            right_side = (patch.centre[0] < face.centre[0]) == (k == RIGHT_HAND)
            return motion_score + (0.1 if right_side else 0.0)
        near = 0.5 * self._height * (1.0 + 2.0 * (hand.unseen - self._step) / _MAX_TIME_LOST)
        return motion_score + float(np.exp(-0.5 * np.sum((patch.centre - hand.centre) ** 2) / near**2))

    def _update(self, k: int, patch: _Patch) -> None:
        """Update blob k with a patch. Its shape is kept if the patch touches the face."""
        old = self.blobs[k]
        jump = old is not None and float(np.linalg.norm(patch.centre - old.centre)) > 1.5 * self._height
        if old is None or jump:
            self.blobs[k] = SkinPatch(patch.centre, patch.covariance, np.zeros(2), 0.5)
            return
        off = patch.centre - old.centre
        shape = old.covariance if patch.crowded else 0.7 * old.covariance + 0.3 * patch.covariance
        limit = (0.5 * self._height) ** 2
        shape = shape * min(1.0, limit / max(float(np.linalg.eigvalsh(shape)[-1]), 1e-9))
        size = min(1.0, patch.size / (0.35 * self._height**2))  # relative to a flat hand
        confidence = _MIN_TRACKED_CONFIDENCE + (1.0 - _MIN_TRACKED_CONFIDENCE) * size
        share, gain = 0.8, 0.3  # of an alpha-beta filter for fast motion
        speed = old.velocity + gain * off / self._step
        self.blobs[k] = SkinPatch(old.centre + share * off, shape, speed, 0.5 * size if patch.crowded else confidence)

    def _learn(self, bins: NDArray, mask: NDArray) -> None:
        """Adapt both histograms to the light: skin from the tracked face, the rest from pixels outside the mask."""
        face = self.blobs[FACE]
        share = 1.0 - float(np.exp(-self._step / _COLOUR_TIME))
        if face is not None and face.unseen == 0.0:
            v, u = np.nonzero(mask)
            own = _squares(np.stack([u, v], axis=-1).astype(float), face.centre, face.covariance) < 4.0
            if own.sum() > 20:
                learnt = _FIRST_SHARE * self._first + (1.0 - _FIRST_SHARE) * _histogram(bins[v[own], u[own]])
                self._skin = (1.0 - share) * self._skin + share * learnt
        self._rest = (1.0 - share) * self._rest + share * _histogram(bins[~mask])


def find_face(image: NDArray, models: Models) -> tuple[float, float, float, float] | None:
    """Face (left, top, width, height) [px] of the most probable person in an RGB image (H, W, 3); None without one."""
    people = Follower(models, 30.0, people=1, masks=False).update(image)
    if not people:
        return None
    return face_box(people[0].points)


def face_box(points: NDArray) -> tuple[float, float, float, float]:
    """Face (left, top, width, height) [px], from hair to chin, from the landmarks (33, 2) [px] of MEDIAPIPE_33."""
    eyes, mouth, ears = points[[2, 5]].mean(axis=0), points[[9, 10]].mean(axis=0), points[[7, 8]]
    down = float(np.linalg.norm(mouth - eyes))
    width = max(float(np.linalg.norm(ears[0] - ears[1])), 1.6 * down)
    u, v = 0.5 * (eyes + mouth)
    return float(u - 0.5 * width), float(v - 1.4 * down), width, 2.8 * down


def _histogram(bins: NDArray) -> NDArray:
    """Share (64 * 64,) of each bin, smoothed by one bin and above zero everywhere."""
    counts = np.bincount(bins.ravel(), minlength=_BINS**2).astype(np.float32).reshape(_BINS, _BINS)
    smooth = cv2.GaussianBlur(counts, (0, 0), 1.0).ravel().astype(float)
    return (smooth + 1e-3) / (smooth.sum() + 1e-3 * _BINS**2)


def _ends(patch: NDArray, length: float) -> list[NDArray]:
    """The patch (N, 2) itself, or the two ends, of a hand's length, of one as long as a bare forearm."""
    middle = patch.mean(axis=0)
    axis = np.linalg.eigh(np.cov(patch.T) + 1e-9 * np.eye(2))[1][:, -1]
    along = (patch - middle) @ axis
    low, high = np.quantile(along, [0.01, 0.99])
    ends = [patch[along < low + length], patch[along > high - length]]
    return ends if high - low >= _MAX_HAND_LENGTHS * length else [patch]


def _squares(x: NDArray, centre: NDArray, covariance: NDArray) -> NDArray:
    """Squared Mahalanobis distances (N,) of points (N, 2)."""
    d = x - centre
    return np.asarray(np.einsum("ni,ij,nj->n", d, np.linalg.inv(covariance), d))
