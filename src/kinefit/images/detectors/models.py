"""The two networks of the built-in detector, run by LiteRT on the CPU (extra `detect`)."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._jit import cache_directory
from kinefit.errors import FileError, ObservationError
from kinefit.images.detectors.box_detector import DetectedPerson, PersonDetector
from kinefit.images.detectors.pose_model import MASK, PersonLandmarks, PoseModel, mean_with_mirrored

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

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    FileError
        A file is missing, not a network, or a network of other inputs and outputs.
    """

    def __init__(
        self, folder: str | PathLike[str], threads: int = 1, landmarks: str | PathLike[str] | None = None, *,
        mirrored: bool = False,
    ) -> None:  # fmt: skip
        self._mirrored = mirrored
        self._landmarks, self._threads = Path(folder) / LANDMARKS if landmarks is None else Path(landmarks), threads
        self._points = _pose_model(self._landmarks, threads, without=MASK)
        self._detect = PersonDetector(interpreter(Path(folder) / DETECTOR, threads))

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
        """Detect small or lying people in an image (H, W, 3) RGB, in order of decreasing score.

        The detector runs on tiles of the image and, if these show none, on the image rotated by quarter turns. This
        search gives more false positives than `find_people`.
        """
        people = []
        for u, v, side in squares(image.shape[1], image.shape[0]):
            part = self._detect(image[v : v + side, u : u + side])
            people += [replace(person, points=person.points + [u, v]) for person in part]
        for quarters in () if people else (1, 3, 2):
            turned = self._detect(np.ascontiguousarray(np.rot90(image, quarters)))
            people += [person.turned_back(quarters, image.shape[:2]) for person in turned]
        return sorted(people, key=lambda person: -person.score)


def squares(width: int, height: int) -> list[tuple[int, int, int]]:
    """Tiles (left, top, side) [px], as high as the image's shorter side and half of it, which overlap by half."""
    found = []
    for side in (min(width, height), min(width, height) // 2):
        lefts, tops = (np.linspace(0, n - side, max(round(2 * n / side) - 1, 1)).astype(int) for n in (width, height))
        found += [(int(u), int(v), side) for v in tops for u in lefts if side < max(width, height) and side > 0]
    return found


def check_runtime() -> None:
    """Raise ObservationError where the extra `detect` is not installed."""
    _runtime()


def _runtime() -> Any:
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
    runtime, remedy = _runtime(), _REMEDY if path.is_relative_to(cache_directory()) else _LAYOUT
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
