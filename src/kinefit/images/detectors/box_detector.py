"""The networks of the detector: people, faces and palms as boxes, by anchors of one size; people and their landmarks.

Source: Bazarevsky et al., BlazeFace, 2019 (anchors, weighted suppression); BlazePose, 2020.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._jit import cache_directory
from kinefit.errors import FileError, ObservationError
from kinefit.images.detectors.layouts import BLAZEPOSE
from kinefit.images.detectors.roi import MASK, PersonLandmarks, PoseModel, Roi, mean_with_mirrored

_MAX_OVERLAP = 0.3  # intersection over union of two boxes; boxes that overlap more show the same object
_MAX_LOGIT = 100.0  # beyond it the exponential overflows


@dataclass(frozen=True, eq=False)
class DetectedBox:
    """One detection: corners (2, 2) [px] upper left and lower right, points (K, 2) [px], score 0..1."""

    corners: NDArray
    points: NDArray
    score: float


class BoxDetector:
    """Detects boxes with points in a whole image.

    Parameters
    ----------
    interpreter
        Of a network with input (1, S, S, 3) and outputs (1, N, 4 + 2 K): boxes and points in pixels from their anchors,
        and (1, N, 1): logits.
    cells : ((stride [px], anchors in a cell), ...)
        Feature maps in the order of the network's anchors.
    low : float
        Input value of black; white is 1.
    """

    def __init__(self, interpreter: Any, cells: Sequence[tuple[int, int]], low: float = -1.0) -> None:
        self._interpreter, self._low = interpreter, low
        details = interpreter.get_input_details()[0]
        self._input, self.size = details["index"], int(details["shape"][1])
        outputs = sorted(interpreter.get_output_details(), key=lambda o: int(o["shape"][-1]))
        self._scores, self._boxes = (o["index"] for o in outputs)
        self._anchors = anchors(self.size, cells)

    def __call__(self, image: NDArray[np.uint8], min_score: float = 0.5) -> list[DetectedBox]:
        """Detections in an RGB image (H, W, 3), in order of decreasing score."""
        square, side, offset = letterboxed(image, self.size)
        values = square * np.float32((1 - self._low) / 255) + np.float32(self._low)
        self._interpreter.set_tensor(self._input, values[None])
        self._interpreter.invoke()
        raw = self._interpreter.get_tensor(self._boxes)[0]
        logits = self._interpreter.get_tensor(self._scores)[0, :, 0]
        found = decode(raw, logits, self._anchors, self.size, min_score)
        return [DetectedBox(v[:2] * side - offset, v[2:] * side - offset, score) for v, score in found]


def anchors(size: int, cells: Sequence[tuple[int, int]]) -> NDArray:
    """Centres (N, 2) of the anchors, in units of the side `size` [px] of the network's image; see `BoxDetector`."""
    maps = []
    for stride, count in cells:
        at = (np.arange(size // stride) + 0.5) * stride / size
        u, v = np.meshgrid(at, at)
        maps.append(np.repeat(np.column_stack([u.ravel(), v.ravel()]), count, axis=0))
    return np.concatenate(maps)


def decode(
    raw: NDArray, logits: NDArray, centres: NDArray, size: int, min_score: float = 0.5
) -> list[tuple[NDArray, float]]:
    """Decode the network's output: corners and points (2 + K, 2) in units of its image's side, and scores.

    Overlapping boxes are merged by a mean that is weighted with their scores.

    Parameters
    ----------
    raw : (N, 4 + 2 K)
        Centre, width and height of the box, then its points; in pixels from the anchor.
    logits : (N,)
    centres : (N, 2) of the anchors
    size : int [px] side of the network's image
    min_score : float in 0..1
    """
    kept = np.flatnonzero(logits > np.log(min_score / (1 - min_score)))
    kept = kept[np.argsort(-logits[kept], kind="stable")]
    scores = 1 / (1 + np.exp(-np.clip(logits[kept], -_MAX_LOGIT, _MAX_LOGIT)))
    values = raw[kept].reshape(len(kept), raw.shape[1] // 2, 2).astype(float) / size
    half = values[:, 1] / 2
    values[:, 1] = values[:, 0]
    values += centres[kept][:, None]
    values[:, 0] -= half
    values[:, 1] += half
    found = []
    while len(scores):
        low, high = values[:, 0], values[:, 1]
        inner = np.prod(np.clip(np.minimum(high, high[0]) - np.maximum(low, low[0]), 0, None), axis=1)
        areas = np.prod(high - low, axis=1)
        duplicate = inner > _MAX_OVERLAP * (areas + areas[0] - inner)
        duplicate[0] = True
        found.append((np.average(values[duplicate], axis=0, weights=scores[duplicate]), float(scores[0])))
        values, scores = values[~duplicate], scores[~duplicate]
    return found


def letterboxed(image: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], float, NDArray]:
    """Letterbox an image (H, W, 3): (size, size, 3) with black bars; and the square's side and offset (2,) [px]."""
    height, width = image.shape[:2]
    side = max(height, width)
    offset = np.array([side - width, side - height]) / 2
    scale = side / size
    A = np.array([[scale, 0, -offset[0]], [0, scale, -offset[1]]])
    square = cv2.warpAffine(image, A, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(square, np.uint8), float(side), offset


CELLS = ((8, 2), (16, 2), (32, 6))  # stride [px] of the feature maps, anchors in a cell
_MIN_PERSON_SCORE = 0.5  # at 0.25 machines in an empty room are false positives


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """A person detected in an image.

    Parameters
    ----------
    points : (2, 2) [px]
        Middle of the hips, and a point above it on the circle around the body.
    score : float, 0..1
    head : (2, 2) [px], optional
        Upper left and lower right corner of a box around the face, visible or not.
    """

    points: NDArray
    score: float
    head: NDArray | None = None

    @property
    def roi(self) -> Roi:
        """Region around the whole body [px]."""
        return Roi.around_person(*self.points)

    def turned_back(self, quarters: int, shape: tuple[int, int]) -> DetectedPerson:
        """Rotate a detection back: from `numpy.rot90` by some quarter turns to the image of shape (height, width)."""
        points, (height, width) = self.points, shape
        if quarters % 2:
            height, width = width, height
        for _ in range(quarters):
            points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
            height, width = width, height
        return DetectedPerson(points, self.score)


class PersonDetector:
    """Detects people in a whole image.

    Parameters
    ----------
    interpreter
        Of `pose_detection.tflite`: from (1, 224, 224, 3) in -1..1 to 2254 boxes with four points each, and scores.
    """

    def __init__(self, interpreter: Any) -> None:
        self._boxes = BoxDetector(interpreter, CELLS)

    def __call__(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """People in an RGB image (H, W, 3), in order of decreasing score."""
        return [DetectedPerson(b.points[:2], b.score, b.corners) for b in self._boxes(image, _MIN_PERSON_SCORE)]

    def search(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """Detect small or lying people in an image (H, W, 3) RGB, in order of decreasing score.

        It is run on tiles of the image and, if these show none, on the image rotated by quarter turns. This search
        gives more false positives.
        """
        people = []
        for u, v, side in squares(image.shape[1], image.shape[0]):
            part = self(image[v : v + side, u : u + side])
            people += [replace(person, points=person.points + [u, v]) for person in part]
        for quarters in () if people else (1, 3, 2):
            turned = self(np.ascontiguousarray(np.rot90(image, quarters)))
            people += [person.turned_back(quarters, image.shape[:2]) for person in turned]
        return sorted(people, key=lambda person: -person.score)


DETECTOR, LANDMARKS = "pose_detection.tflite", "pose_landmark_full.tflite"
_REMEDY = "Delete its folder; kinefit then fetches it again."
_LAYOUT = (
    "Name a landmark network of BlazePose: input (1, 256, 256, 3); outputs (1, 195), (1, 1), (1, 64, 64, 39), (1, 117) "
    "and, for outlines, (1, 256, 256, 1)."
)


class Models:
    """Networks that detect people in an image and a person's landmarks in a region. Not thread-safe.

    Parameters
    ----------
    folder : path
        Of the two files.
    threads : int
        For each network; results do not depend on it.
    landmarks : path
        Of another landmark network with the same inputs and outputs; default that of the folder.
    mirrored : bool
        Each crop is evaluated a second time, mirrored, and both results are averaged.
    people : with the methods of `PersonDetector`, another detector of people; default that of the folder

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    FileError
        A file is missing, not a network, or a network of other inputs and outputs.
    """

    layout = BLAZEPOSE

    def __init__(
        self, folder: str | PathLike[str], threads: int = 1, landmarks: str | PathLike[str] | None = None, *,
        mirrored: bool = False, people: Any = None,
    ) -> None:  # fmt: skip
        self._mirrored = mirrored
        self._landmarks, self._threads = Path(folder) / LANDMARKS if landmarks is None else Path(landmarks), threads
        self._points = _pose_model(self._landmarks, threads, without=MASK)
        self._detect = people or PersonDetector(interpreter(Path(folder) / DETECTOR, threads))

    @cached_property
    def _with_mask(self) -> PoseModel:
        return _pose_model(self._landmarks, self._threads)

    def pose(self, crop: NDArray[np.uint8], *, mask: bool = True) -> PersonLandmarks:
        """Landmarks of the person in an RGB crop (256, 256, 3). The mask nearly doubles the time."""
        network = self._with_mask if mask else self._points
        seen = network(crop)
        return mean_with_mirrored(seen, network(crop[:, ::-1])) if self._mirrored else seen

    def find_people(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """Detect people in an image (H, W, 3) RGB who fill a quarter of its height, in order of decreasing score."""
        return self._detect(image)

    def search(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """Detect small or lying people in an image (H, W, 3) RGB; see `PersonDetector.search`."""
        return self._detect.search(image)


def squares(width: int, height: int) -> list[tuple[int, int, int]]:
    """Tiles (left, top, side) [px], as high as the image's shorter side and half of it, which overlap by half."""
    found = []
    for side in (min(width, height), min(width, height) // 2):
        lefts, tops = (np.linspace(0, n - side, max(round(2 * n / side) - 1, 1)).astype(int) for n in (width, height))
        found += [(int(u), int(v), side) for v in tops for u in lefts if side < max(width, height) and side > 0]
    return found


def litert_interpreter() -> Any:
    """The class of the networks' runtime, LiteRT; raises ObservationError where the extra `detect` is not installed."""
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise ObservationError(
            f"the runtime of the built-in detector is not installed ({error})",
            remedy="Run: pip install 'kinefit[detect]'.",
        ) from error
    return Interpreter


def _pose_model(path: Path, threads: int, without: tuple[int, ...] = ()) -> PoseModel:
    try:
        return PoseModel(interpreter(path, threads, without))
    except KeyError as error:
        raise FileError(f"a network without inputs or outputs of shape {error}", file=path, remedy=_LAYOUT) from error


def interpreter(path: Path, threads: int, without: tuple[int, ...] = ()) -> Any:
    """Load a network; `without` the output of that shape, and the operators that only it needs.

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    FileError
        The file is missing or not a network.
    """
    runtime, remedy = litert_interpreter(), _REMEDY if path.is_relative_to(cache_directory()) else _LAYOUT
    if not path.is_file():
        raise FileError("no such network", file=path, remedy=remedy)
    try:
        given = {"model_content": _reduced(path, without)} if without else {"model_path": str(path)}
        network = runtime(**given, num_threads=threads)
        network.allocate_tensors()
    except (ValueError, RuntimeError, TypeError, LookupError, AttributeError, struct.error) as error:
        raise FileError(f"not a network that LiteRT runs ({error})", file=path, remedy=remedy) from error
    return network


@lru_cache(maxsize=2)
def _reduced(path: Path, without: tuple[int, ...]) -> bytes:
    """A network's file without the output of that shape; its other outputs stay the same, bit for bit."""
    import flatbuffers
    from ai_edge_litert import schema_py_generated as schema

    content = path.read_bytes()
    if not schema.Model.ModelBufferHasIdentifier(content, 0):
        raise ValueError("it is not a file of TensorFlow Lite")
    model = schema.ModelT.InitFromObj(schema.Model.GetRootAs(content, 0))
    graph = model.subgraphs[0]
    graph.outputs = [k for k in graph.outputs if tuple(graph.tensors[k].shape) != without]
    needed, kept = set(graph.outputs), []
    for operator in reversed(graph.operators):
        if needed.intersection(operator.outputs):
            kept.append(operator)
            needed.update(operator.inputs)
    graph.operators = kept[::-1]
    builder = flatbuffers.Builder(len(content))
    builder.Finish(model.Pack(builder), b"TFL3")
    return bytes(builder.Output())
