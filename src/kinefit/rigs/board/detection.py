"""Detect calibration boards in images: checkerboards and ChArUco boards, upright, turned or inverted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError

DICTIONARIES = tuple(
    [f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)]
    + ["ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11", "ARUCO_MIP_36h12"]
)
SPELLING = "checkerboard:COLUMNSxROWS:SQUARE (inner corners, metres) or charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]"
_MIN_CORNERS = 6  # of a partly visible board: enough for its pose and a check of it
_MAX_PLANE_ERROR = 0.04  # of the board's extent in the image: more than the distortion of a common lens


@dataclass(frozen=True)
class Board:
    """A flat board with known corners.

    Its frame: origin in the first inner corner (top left, seen upright), x to the right along the rows, y up along the
    columns, z out of the printed face.

    Parameters
    ----------
    kind : "checkerboard" or "charuco"
    size : (columns, rows)
        Inner corners of a checkerboard, squares of a ChArUco board.
    square, marker : float [m]
        Edge of a square, and of a marker in it.
    dictionary : str
        Of the markers, such as "4X4_50"; empty: detected in the images.
    legacy : bool
        ChArUco boards printed by OpenCV before 4.6 with an even number of rows.
    """

    kind: str
    size: tuple[int, int]
    square: float
    marker: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    def __post_init__(self) -> None:
        smallest = 3 if self.kind == "charuco" else 2
        if self.kind not in ("checkerboard", "charuco"):
            self._raise(f"no board '{self.kind}'")
        if min(self.size) < smallest or max(self.size) > 200:
            self._raise(f"a board of {self.size[0]}x{self.size[1]}")
        if not 0 < self.square < 10:  # 10 m must be millimetres
            self._raise(f"squares of {self.square:g} m")
        if self.kind == "charuco" and not 0 < self.marker < self.square:
            self._raise(f"markers of {self.marker:g} m in squares of {self.square:g} m")
        if self.kind == "charuco" and self.dictionary and self.dictionary not in DICTIONARIES:
            self._raise(f"no dictionary '{self.dictionary}'; there are: {', '.join(DICTIONARIES)}")

    def _raise(self, problem: str) -> None:
        raise CalibrationError(problem, place="board", remedy=f"Write {SPELLING}, for example charuco:5x7:0.04:0.03.")

    @classmethod
    def parse(cls, text: str) -> Board:
        """Board of a text such as "checkerboard:9x6:0.025" or "charuco:5x7:0.04:0.03:5X5_100[:legacy]".

        Raises CalibrationError for any other text.
        """
        kind, *parts = text.strip().split(":")
        wrong = CalibrationError(f"cannot read the board '{text}'", place="board", remedy=f"Write {SPELLING}.")
        try:
            columns, rows = (int(part) for part in parts[0].lower().split("x"))
            square = float(parts[1])
            if kind != "charuco":
                if len(parts) > 2:
                    raise wrong
                return cls(kind, (columns, rows), square)
            legacy = parts[-1] == "legacy"
            rest = parts[3 : len(parts) - legacy]
            if len(rest) > 1:
                raise wrong
            known = {name.upper(): name for name in DICTIONARIES}
            given = "".join(rest).upper().removeprefix("DICT_")
            return cls(kind, (columns, rows), square, float(parts[2]), known.get(given, given), legacy)
        except (ValueError, IndexError):
            raise wrong from None

    def __str__(self) -> str:
        text = f"{self.kind}:{self.size[0]}x{self.size[1]}:{self.square:g}"
        if self.kind == "charuco":
            text += f":{self.marker:g}" + (f":{self.dictionary}" if self.dictionary else "")
        return text + ":legacy" * self.legacy

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of inner corners."""
        less = self.kind == "charuco"
        return self.size[0] - less, self.size[1] - less

    @cached_property
    def corners(self) -> NDArray:
        """(N, 3) [m] inner corners in the board's frame, row by row from the top left."""
        columns, rows = self.grid
        v, u = np.mgrid[:rows, :columns]
        return self.square * np.stack([u.ravel(), -v.ravel(), np.zeros(rows * columns)], axis=1)

    @cached_property
    def symmetries(self) -> tuple[NDArray, ...]:
        """Orders (N,) of the corners under the rotations that map the board onto itself; the first is the identity."""
        columns, rows = self.grid
        index = np.arange(columns * rows).reshape(rows, columns)
        if self.kind == "charuco":
            return (index.ravel(),)
        orders = [np.rot90(index, k) for k in (range(4) if columns == rows else (0, 2))]
        dark = np.indices((rows - 1, columns - 1)).sum(axis=0) % 2
        patterns = [np.rot90(dark, k) for k in (range(4) if columns == rows else (0, 2))]
        return tuple(order.ravel() for order, p in zip(orders, patterns) if np.array_equal(p, dark))


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in one image: its corners `ids` (n,) at `uv` (n, 2) [px]; `mirrored` if its back is visible."""

    frame: int
    ids: NDArray
    uv: NDArray
    mirrored: bool = False


@dataclass(frozen=True, eq=False)
class CameraViews:
    """All views of the board in one camera: image size (width, height) [px] and the views, in order of frames."""

    size: tuple[int, int]
    views: tuple[BoardView, ...]

    @property
    def frames(self) -> dict[int, BoardView]:
        """{frame: view}."""
        return {view.frame: view for view in self.views}

    @property
    def uv(self) -> NDArray:
        """(M, 2) [px] of all corners."""
        return np.concatenate([np.zeros((0, 2)), *(view.uv for view in self.views)])


class Finder:
    """Finder of one board in images; remembers whether it is printed white on black.

    A ChArUco board may have its mirror image on its back, corner on corner, as caliscope's boards have.

    Parameters
    ----------
    board : Board, with its dictionary.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._ways = [(inverted, mirrored) for mirrored in (False, True) for inverted in (False, True)]
        if board.kind == "charuco":
            whole = _dictionary(board.dictionary)
            own = whole.bytesList[: (board.size[0] * board.size[1]) // 2]  # the board has no others
            markers = cv2.aruco.Dictionary(own, whole.markerSize, whole.maxCorrectionBits)
            pattern = cv2.aruco.CharucoBoard(board.size, board.square, board.marker, markers)
            pattern.setLegacyPattern(board.legacy)
            self._detector = cv2.aruco.CharucoDetector(pattern)

    def find(self, image: NDArray, frame: int) -> BoardView | None:
        """Find the board in an image (H, W, 3) RGB or (H, W) grey; None if it is not visible."""
        grey = grey_image(image)
        if self.board.kind == "checkerboard":
            return self._checkerboard(grey, frame)
        for way in self._ways:
            view = self._charuco(grey, frame, *way)
            if view is not None:
                inverted = way[0]
                self._ways = [way, (inverted, not way[1])]
                return view
        return None

    def _charuco(self, grey: NDArray, frame: int, inverted: bool, mirrored: bool) -> BoardView | None:
        grey = 255 - grey if inverted else grey
        uv, ids, _, _ = self._detector.detectBoard(np.ascontiguousarray(grey[:, ::-1]) if mirrored else grey)
        if ids is None or len(ids) < _MIN_CORNERS:
            return None
        uv = uv.reshape(-1, 2).astype(float)
        if not _is_plane(ids.ravel(), uv, self.board):
            return None
        if mirrored:
            uv[:, 0] = grey.shape[1] - 1 - uv[:, 0]
        return BoardView(frame, ids.ravel().astype(int), uv, mirrored)

    def _checkerboard(self, grey: NDArray, frame: int) -> BoardView | None:
        columns, rows = self.board.grid
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, uv = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
        if not found:
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
            found, uv = cv2.findChessboardCornersSB(grey, (columns, rows), flags=flags)
        if not found:
            return None
        grid = uv.reshape(rows, columns, 2).astype(float)
        step = min(np.linalg.norm(np.diff(grid, axis=a), axis=2).min() for a in (0, 1))
        window = int(np.clip(0.4 * step, 2, 15))  # contains no other corner
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
        points = cv2.cornerSubPix(grey, uv.reshape(-1, 1, 2).astype(np.float32), (window, window), (-1, -1), stop)
        return BoardView(
            frame, np.arange(columns * rows), _upright(points.reshape(rows, columns, 2), grey).reshape(-1, 2)
        )


def _upright(grid: NDArray, grey: NDArray) -> NDArray:
    """Order corners (rows, columns, 2) without mirroring, beginning at a dark square if one end has one."""
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid = grid[:, ::-1]

    def brightness(v: int, u: int) -> float:
        x, y = grid[v : v + 2, u : u + 2].mean(axis=(0, 1))
        patch = cv2.getRectSubPix(grey, (3, 3), (float(x), float(y)))
        return float(patch.mean())

    turns = range(4) if grid.shape[0] == grid.shape[1] else (0, 2)
    first, other = brightness(0, 0), brightness(0, 1) if grid.shape[1] > 2 else 255.0
    if first > other:
        for turn in turns:
            turned = np.rot90(grid, turn)
            x, y = turned[:2, :2].mean(axis=(0, 1))
            if cv2.getRectSubPix(grey, (3, 3), (float(x), float(y))).mean() < 0.5 * (first + other):
                return turned.astype(float)
    return grid.astype(float)


def _is_plane(ids: NDArray, uv: NDArray, board: Board) -> bool:
    """Whether the corners fit a plane; misread markers, or those of another board, do not."""
    flat = board.corners[ids][:, :2]
    if np.linalg.matrix_rank(flat - flat.mean(axis=0), tol=0.5 * board.square) < 2:
        return False
    H, _ = cv2.findHomography(flat, uv)
    if H is None:
        return False
    error = cv2.perspectiveTransform(flat[None], H)[0] - uv
    # From its front a board's frame, y up, is mirrored in the image, v down.
    return bool(np.abs(error).max() < _MAX_PLANE_ERROR * np.ptp(uv, axis=0).max() and np.linalg.det(H) * H[2, 2] < 0)


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def with_dictionary(board: Board, images: Sequence[NDArray]) -> Board:
    """The board with the dictionary of most markers in images (H, W) or (H, W, 3), unless it names one."""
    if board.kind != "charuco" or board.dictionary:
        return board
    names = _dictionaries_seen(board, images)
    return replace(board, dictionary=names[0] if names else "4X4_50")


def fitting_boards(board: Board, images: Sequence[NDArray]) -> list[Board]:
    """Other boards visible in images (H, W) or (H, W, 3): another dictionary, legacy pattern or size; best first."""
    greys = [grey_image(image) for image in images]
    found: dict[Board, int] = {}
    if board.kind == "charuco":
        for name in _dictionaries_seen(board, greys)[:2]:
            for size, legacy in product(dict.fromkeys((board.size, board.size[::-1])), (False, True)):
                other = replace(board, dictionary=name, size=size, legacy=legacy)
                finder = Finder(other)
                found[other] = sum(finder.find(grey, 0) is not None for grey in greys)
    else:
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        for grey in greys:
            seen, _, squares = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
            if seen:
                rows, columns = sorted(squares.shape[:2])
                other = replace(board, size=(columns, rows))
                found[other] = found.get(other, 0) + 1
    return sorted((other for other, count in found.items() if count), key=lambda other: -found[other])


def _dictionaries_seen(board: Board, images: Iterable[NDArray]) -> list[str]:
    """Dictionaries with visible markers, most first; of each family the smallest with enough for the board."""
    needed = board.size[0] * board.size[1] // 2
    families: dict[str, str] = {}
    for name in DICTIONARIES:  # names of one family have a common prefix
        if len(_dictionary(name).bytesList) >= needed:
            families.setdefault(name.partition("_")[0] if name[1] == "X" else name, name)
    greys = [grey for image in images for grey in (grey_image(image), 255 - grey_image(image))]
    counts = {}
    for name in families.values():
        detector = cv2.aruco.ArucoDetector(_dictionary(name))
        found = [detector.detectMarkers(grey)[1] for grey in greys]
        counts[name] = sum(len(ids) for ids in found if ids is not None)
    # Noise is sometimes read as a marker; a board has several.
    return sorted((name for name, count in counts.items() if count >= 4), key=lambda name: -counts[name])


def grey_image(image: NDArray) -> NDArray:
    """(H, W) grey values of an image in RGB (H, W, 3), or in grey already."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
