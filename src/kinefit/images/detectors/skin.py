"""Face and hands by the colour of the skin: a 2D tracker that learns the colour from a face and follows the light.

Colour is told by a histogram over chromaticity (Lab's a and b) against that of the rest of the picture, as in Argyros &
Lourakis (ECCV 2004); which patches are the hands, by where the hands went and by what moves.
`detection` finds more by networks; this needs none once the face is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import rgb_image
from kinefit.errors import ObservationError
from kinefit.images.detectors.detection import Follower
from kinefit.images.detectors.models import Models
from kinefit.observations import KeypointFrame

FACE, LEFT, RIGHT = 0, 1, 2
LANDMARKS = ("nose_tip", "l_metacarpal_phalanx_3", "r_metacarpal_phalanx_3")  # where the middles of the blobs lie
WRISTS = ("nose_tip", "l_wrist", "r_wrist")  # for bodies without fingers; the middle of a hand lies 8 cm beyond

_BINS = 64  # of a and of b
_SHARE = 0.1  # of a picture is skin, before it is looked at
_SIDE = 320  # [px] longer side at which blobs are sought: a hand of a whole person is then some 8 px wide
_HAND = 0.8  # length of a hand, in heights of the face (0.19 m to 0.24 m)
_LEAST = 0.06  # area of a blob, in squares of the face's height: a fist seen from the side is 0.1
_PIXELS = 6  # of a blob at least, so that it has a size and a direction
_MANY = 8  # patches among which the hands are chosen
_LONG = 1.3  # times a hand's length: longer blobs are bare forearms with a hand at one end
_COAST = 0.5  # [s] for which somebody unseen is expected to go on
_LEARN = 2.0  # [s] in which the light may change
_STIR = 1.0  # [s] for which a movement is remembered
_MOVED = 10  # [grey levels] by which a pixel differs between pictures where something moved: above a webcam's noise
_NOBODY = 0.6  # in favour of seeing no hand: less than a hand where it was, more than a patch elsewhere that is still
_BOWED = 16.0  # square of the face's half size within which it is sought where it is not: bows between two pictures
_BESIDE = 0.8  # [heights of the face] from its middle to its corners, and to the chin's neck
_REACH = 5.5  # [heights of the face] an arm's length and half the shoulders' width; faces are found a fifth too small
_SURE = 0.8  # confidence at least of a patch that was followed: it is seen (`sensors.occlusion`), no guess
_KEPT = 0.3  # of the first colour stays for good: what is learnt cannot drift away altogether


@dataclass(frozen=True, eq=False)
class SkinPatch:
    """A patch of skin: centre (2,) [px], covariance (2, 2) [px²], velocity (2,) [px/s], confidence, unseen for [s]."""

    centre: NDArray
    covariance: NDArray
    velocity: NDArray
    confidence: float
    unseen: float = 0.0


@dataclass(frozen=True, eq=False)
class _Patch:
    """Pixels that hang together: centre (2,), covariance (2, 2), number, share that moved, label, beside the face."""

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
    """Face and hands of one person in one camera.

    Left and right are the person's, who is taken to face the camera, arms not crossed, when a hand comes into view;
    from then on they may cross. A bare forearm hides where its hand ends: there the end that moves more is taken.

    Parameters
    ----------
    image : (H, W, 3) uint8 RGB, the first picture
    face : (left, top, width, height) [px] of the face in it, from hair to chin; see `find_face`.
    rate : float [Hz]

    Raises
    ------
    ObservationError
        An image that is none, or a face that is not in it.
    """

    def __init__(self, image: NDArray, face: tuple[float, float, float, float], *, rate: float = 30.0) -> None:
        self._check(image)
        left, top, width, height = (float(v) for v in face)
        h, w = image.shape[:2]
        seen = left < w and top < h and left + width > 0 and top + height > 0
        if not (min(width, height) >= 8 and width <= 2 * w and height <= 2 * h and seen):
            remedy = "Give (left, top, width, height) in pixels: 8 px or more, no larger than the picture."
            raise ObservationError(f"no face at {tuple(face)} in a picture of {w}x{h} px", remedy=remedy)
        if not rate > 0:
            raise ObservationError(f"a rate of {rate} Hz", remedy="Give pictures per second.")
        self._shape, self._step = image.shape, 1.0 / rate
        self._scale = min(1.0, _SIDE / max(h, w))
        self._height = height * self._scale  # of the face, in the small picture
        self._least = max(_LEAST * self._height**2, _PIXELS)
        centre = self._scale * np.array([left + 0.5 * width, top + 0.5 * height])
        spread = np.diag([0.25 * width * self._scale, 0.25 * height * self._scale]) ** 2
        self.blobs: list[SkinPatch | None] = [SkinPatch(centre, spread, np.zeros(2), 1.0), None, None]
        self._grey: NDArray | None = None
        bins = self._chroma(image)
        self._stir = np.zeros(bins.shape, np.float32)
        v, u = np.mgrid[: bins.shape[0], : bins.shape[1]]
        from_face = np.sqrt(_squares(np.stack([u, v], -1).reshape(-1, 2), centre, spread)).reshape(bins.shape)
        self._first = self._skin = _histogram(bins[from_face < 1.2])  # inside of hair, ears and what is behind
        self._rest = _histogram(bins[from_face > 3.0])

    def _check(self, image: NDArray) -> None:
        rgb_image(image)

    def _chroma(self, image: NDArray) -> NDArray:
        """(h, w) bin of every pixel of the small picture; takes note of what moves in it."""
        size = (round(image.shape[1] * self._scale), round(image.shape[0] * self._scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        if self._grey is not None:
            share = 1.0 - float(np.exp(-self._step / _STIR))
            moves = (cv2.absdiff(grey, self._grey) > _MOVED).astype(np.float32)
            self._stir = (1.0 - share) * self._stir + share * moves
        self._grey = grey
        lab = cv2.cvtColor(small.astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab)
        fine = np.clip((lab[..., 1:] + 48.0) * (_BINS / 96.0), 0, _BINS - 1).astype(np.int64)
        return np.asarray(fine[..., 0] * _BINS + fine[..., 1])

    def update(self, image: NDArray) -> tuple[SkinPatch | None, SkinPatch | None, SkinPatch | None]:
        """Face, left and right hand in the next picture; None for one that was not seen or is lost."""
        self._check(image)
        if image.shape != self._shape:
            problem = f"a picture of shape {image.shape} after one of {self._shape}"
            raise ObservationError(problem, remedy="Start a new tracker for another camera.")
        bins = self._chroma(image)
        p = (self._skin * _SHARE / (self._skin * _SHARE + self._rest * (1.0 - _SHARE)))[bins].astype(np.float32)
        p = cv2.GaussianBlur(p, (0, 0), max(0.03 * self._height, 0.5))
        mask = (p > 0.5).astype(np.uint8)
        self._predict()
        self._see_face(mask)
        self._see_hands(self._candidates(mask))
        self._learn(bins, mask > 0)
        return tuple(self._shown(b) for b in self.blobs)  # type: ignore[return-value]

    def frame(self, sensor: str, time: float, names: tuple[str, str, str] = LANDMARKS) -> KeypointFrame:
        """What was seen last as keypoints of a camera: points of the body's landmarks on rays."""
        seen = [self._shown(b) for b in self.blobs]
        uv = np.array([b.centre if b else (np.nan, np.nan) for b in seen])
        return KeypointFrame(sensor, time, names, uv, np.array([b.confidence if b else 0.0 for b in seen]))

    def _shown(self, b: SkinPatch | None) -> SkinPatch | None:
        if b is None or b.unseen > 0.0:
            return None
        s = 1.0 / self._scale
        return replace(b, centre=(b.centre + 0.5) * s - 0.5, covariance=b.covariance * s**2, velocity=b.velocity * s)

    def _predict(self) -> None:
        for k, b in enumerate(self.blobs):
            if b is not None:
                gone = b.unseen + self._step
                speed = 0.7 * b.velocity  # a hand turns round more often than it goes on
                moved = replace(b, centre=b.centre + self._step * speed, velocity=speed, unseen=gone, confidence=0.0)
                self.blobs[k] = moved if gone <= _COAST or k == FACE else None

    def _see_face(self, mask: NDArray) -> None:
        """The face is what skin there is within its ellipse, a little enlarged."""
        face = self.blobs[FACE]
        assert face is not None
        v, u = np.nonzero(mask)
        pixels = np.stack([u, v], axis=-1).astype(float)
        far = _squares(pixels, face.centre, face.covariance + np.eye(2) * (0.1 * self._height) ** 2)
        for reach in (4.0, _BOWED):
            if (far < reach).sum() > self._least:
                self._see(FACE, _Patch.of(pixels[far < reach], 0.0, -1, False))
                return

    def _hand_near(self, patch: _Patch) -> bool:
        """Whether a hand was on its way to a patch beside the face: else that is the face's own, brow or neck."""
        hands = [b for b in self.blobs[LEFT:] if b is not None]
        return any(np.linalg.norm(b.centre - patch.centre) < _BESIDE * self._height for b in hands)

    def _candidates(self, mask: NDArray) -> list[_Patch]:
        """What may be a hand: patches of skin outside of the face; of a long one, both ends."""
        face, height = self.blobs[FACE], self._height
        assert face is not None
        v, u = np.nonzero(mask)
        pixels = np.stack([u, v], axis=-1).astype(float)
        inside = _squares(pixels, face.centre, face.covariance) < 5.0
        outside = mask.copy()
        outside[v[inside], u[inside]] = 0
        rim = cv2.dilate(mask - outside, np.ones((3, 3), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=8)
        out = []
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] < self._least:
                continue
            rows, columns = np.nonzero(labels == k)
            crowded = bool(rim[rows, columns].any())
            patch = np.stack([columns, rows], axis=-1).astype(float)
            for part in (p for p in _ends(patch, _HAND * height) if len(p) >= _PIXELS):
                x, y = part.astype(int).T
                one = _Patch.of(part, float(self._stir[y, x].mean()), k, crowded)
                away = float(np.linalg.norm(one.centre - face.centre))
                if away < _REACH * height and not (crowded and away < _BESIDE * height and not self._hand_near(one)):
                    out.append(one)
        return out

    def _see_hands(self, found: list[_Patch]) -> None:
        """Give each hand its patch, or none: the pair with the most in its favour (see `_favour`)."""
        most = max([0.1, *(p.movement for p in found)])
        found = sorted(found, key=lambda p: -max(self._favour(k, p, most) for k in (LEFT, RIGHT)))[:_MANY]
        options: list[_Patch | None] = [None, *found]
        chosen, best = (options[0], options[0]), 2.0 * _NOBODY
        for left in options:
            for right in options:
                if left and right and left.label == right.label:
                    continue  # both ends of one arm
                sides = 0.3 if left and right and left.centre[0] > right.centre[0] else 0.0
                favour = self._favour(LEFT, left, most) + self._favour(RIGHT, right, most) + sides
                if favour > best:
                    chosen, best = (left, right), favour
        for k, patch in zip((LEFT, RIGHT), chosen):
            if patch is not None:
                self._see(k, patch)

    def _favour(self, k: int, patch: _Patch | None, most: float) -> float:
        """What speaks for a patch as a hand: that it is where the hand went (0..1), and that it moves (0..2).

        Hands move: wood, carpets and the forearm below a watch, which look alike, do so less. A hand at rest stays one.
        """
        if patch is None:
            return _NOBODY
        hand, face = self.blobs[k], self.blobs[FACE]
        assert face is not None
        lively = 2.0 * patch.movement / most
        if hand is None:
            right_side = (patch.centre[0] < face.centre[0]) == (k == RIGHT)
            return lively + (0.1 if right_side else 0.0)
        near = 0.5 * self._height * (1.0 + 2.0 * (hand.unseen - self._step) / _COAST)
        return lively + float(np.exp(-0.5 * np.sum((patch.centre - hand.centre) ** 2) / near**2))

    def _see(self, k: int, patch: _Patch) -> None:
        """Take a patch as what is seen of one; beside the face it keeps its shape."""
        old = self.blobs[k]
        jump = old is not None and float(np.linalg.norm(patch.centre - old.centre)) > 1.5 * self._height
        if old is None or jump:
            self.blobs[k] = SkinPatch(patch.centre, patch.covariance, np.zeros(2), 0.5)
            return
        off = patch.centre - old.centre
        shape = old.covariance if patch.crowded else 0.7 * old.covariance + 0.3 * patch.covariance
        limit = (0.5 * self._height) ** 2
        shape = shape * min(1.0, limit / max(float(np.linalg.eigvalsh(shape)[-1]), 1e-9))
        size = min(1.0, patch.size / (0.35 * self._height**2))  # of a hand seen flat
        sure = _SURE + (1.0 - _SURE) * size  # what was there before and has the colour is seen, also from the side
        share, gain = 0.8, 0.3  # of an alpha-beta filter for brisk movements
        speed = old.velocity + gain * off / self._step
        self.blobs[k] = SkinPatch(old.centre + share * off, shape, speed, 0.5 * size if patch.crowded else sure)

    def _learn(self, bins: NDArray, mask: NDArray) -> None:
        """Follow the light: skin's colour from what is taken for the face, the rest's from what is no skin."""
        face = self.blobs[FACE]
        share = 1.0 - float(np.exp(-self._step / _LEARN))
        if face is not None and face.unseen == 0.0:
            v, u = np.nonzero(mask)
            own = _squares(np.stack([u, v], axis=-1).astype(float), face.centre, face.covariance) < 4.0
            if own.sum() > 20:
                learnt = _histogram(bins[v[own], u[own]])
                self._skin = (1.0 - share) * self._skin + share * (_KEPT * self._first + (1.0 - _KEPT) * learnt)
        self._rest = (1.0 - share) * self._rest + share * _histogram(bins[~mask])


def find_face(image: NDArray, models: Models) -> tuple[float, float, float, float] | None:
    """(left, top, width, height) [px] of the surest person's face in an RGB picture (H, W, 3); None without one."""
    people = Follower(models, 30.0, people=1, masks=False).update(image)
    if not people:
        return None
    return face_box(people[0].points)


def face_box(points: NDArray) -> tuple[float, float, float, float]:
    """(left, top, width, height) [px] of a face, from hair to chin, by the landmarks (33, 2) of a MEDIAPIPE_33."""
    eyes, mouth, ears = points[[2, 5]].mean(axis=0), points[[9, 10]].mean(axis=0), points[[7, 8]]
    down = float(np.linalg.norm(mouth - eyes))
    width = max(float(np.linalg.norm(ears[0] - ears[1])), 1.6 * down)
    u, v = 0.5 * (eyes + mouth)
    return float(u - 0.5 * width), float(v - 1.4 * down), width, 2.8 * down


def _histogram(bins: NDArray) -> NDArray:
    """(64 * 64,) share of each bin, smoothed by one bin, nowhere quite zero."""
    counts = np.bincount(bins.ravel(), minlength=_BINS**2).astype(np.float32).reshape(_BINS, _BINS)
    smooth = cv2.GaussianBlur(counts, (0, 0), 1.0).ravel().astype(float)
    return (smooth + 1e-3) / (smooth.sum() + 1e-3 * _BINS**2)


def _ends(patch: NDArray, length: float) -> list[NDArray]:
    """A patch (N, 2); of one so long that it is a bare forearm, both its ends of a hand's length."""
    middle = patch.mean(axis=0)
    axis = np.linalg.eigh(np.cov(patch.T) + 1e-9 * np.eye(2))[1][:, -1]
    along = (patch - middle) @ axis
    low, high = np.quantile(along, [0.01, 0.99])
    return [patch] if high - low < _LONG * length else [patch[along < low + length], patch[along > high - length]]


def _squares(x: NDArray, centre: NDArray, covariance: NDArray) -> NDArray:
    """(N,) squared distances (Mahalanobis) of points (N, 2)."""
    d = x - centre
    return np.asarray(np.einsum("ni,ij,nj->n", d, np.linalg.inv(covariance), d))
