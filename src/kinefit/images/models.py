"""The two networks of the built-in detector, run by LiteRT on the processor (extra `detect`)."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, ObservationError
from kinefit.images.person_detector import Person, PersonDetector
from kinefit.images.pose_model import PoseModel

DETECTOR, LANDMARKS = "pose_detection.tflite", "pose_landmark_full.tflite"
_REMEDY = "Delete its folder; it is then fetched again."


class Models:
    """Networks that find people in a picture and their landmarks in a region; not to be shared between threads.

    Parameters
    ----------
    folder : path
        With the two files.
    threads : int
        That each network runs on; the answers are the same.

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    FileError
        A file is missing or not a network.
    """

    def __init__(self, folder: str | PathLike[str], threads: int = 1) -> None:
        self.pose = PoseModel(_interpreter(Path(folder) / LANDMARKS, threads))
        self._detect = PersonDetector(_interpreter(Path(folder) / DETECTOR, threads))

    def find_people(self, image: NDArray[np.uint8]) -> list[Person]:
        """People in a picture (H, W, 3) RGB, the surest first; a quarter of the picture's height or more."""
        return self._detect(image)

    def search(self, image: NDArray[np.uint8]) -> list[Person]:
        """Those who are small or lie, the surest first: in parts of the picture, or in the picture turned by quarters.

        There is more in a picture that looks like a person when it is looked at so closely.
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
    """Squares (left, top, side) [px] as high as the picture's shorter side and half of it, each half over the next."""
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


def _interpreter(path: Path, threads: int) -> Any:
    runtime = _runtime()
    if not path.is_file():
        raise FileError("no such network", file=path, remedy=_REMEDY)
    try:
        interpreter = runtime(str(path), num_threads=threads)
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise FileError(f"not a network that LiteRT runs ({error})", file=path, remedy=_REMEDY) from error
    return interpreter
