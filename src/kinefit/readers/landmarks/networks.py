"""Landmark networks of a user's own: the file beside one that describes it, its points, how exact its scores are.

NETWORK.toml, beside NETWORK.onnx, may state any of these keys; NETWORK.sigma.toml is what `kinefit detect --calibrate`
leaves:

    points = "COCO_17"              # the set of its points, or a list of their names
    mapping = { Nose = 0 }          # points of that set that it gives: their numbers among its own
    mean = [123.675, 116.28, 103.53]
    std = [58.395, 57.12, 57.375]   # of red, green and blue; (pixel * scale - mean) / std
    scale = 1.0
    colours = "RGB"                 # or "BGR", the order of its input
    size = [192, 256]               # [px] width and height of an input of any size
    output = ["simcc_x", "simcc_y"] # those of its outputs that count
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml, read_text, write_text
from kinefit.errors import FileError, check_choice
from kinefit.images.detectors import networks
from kinefit.images.detectors.layouts import PointLayout
from kinefit.images.detectors.networks import IMAGENET_MEAN, IMAGENET_STD, CropInput, CropPoints
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.keypoint_sets import HAND_POINTS, KEYPOINT_SETS
from kinefit.readers.plugins import Extension, Extensions

_SETS = ("COCO_17", "HALPE_26", "COCO_WHOLEBODY_133", "BODY_25", "MEDIAPIPE_33")  # by their different numbers of points
_CORRECT = "Correct the name there."

_Three = tuple[float, float, float]
_Scale = Annotated[float, msgspec.Meta(gt=0)]
_Side = Annotated[int, msgspec.Meta(gt=0)]


class NetworkDescription(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What NETWORK.toml states; see the module. None and empty: as the network itself tells, or as MMPose trains."""

    points: str | list[str] | None = None
    mapping: dict[str, Annotated[int, msgspec.Meta(ge=0)]] = {}
    mean: _Three | None = None
    std: tuple[_Scale, _Scale, _Scale] | None = None
    scale: _Scale = 1.0
    colours: Literal["RGB", "BGR"] | None = None
    size: tuple[_Side, _Side] | None = None
    output: str | list[str] | None = None

    @property
    def values(self) -> CropInput:
        """What becomes of the pixels."""
        return CropInput(self.mean or IMAGENET_MEAN, self.std or IMAGENET_STD, self.colours or "RGB", self.scale)

    @property
    def outputs(self) -> list[str] | None:
        """Names of the outputs that count; None: all."""
        return [self.output] if isinstance(self.output, str) else self.output


def description_file(network: Path) -> Path:
    """The file beside a network that describes it."""
    return network.with_suffix(".toml")


def read_description(network: Path) -> NetworkDescription:
    """What is stated beside a network, nothing where there is no such file.

    Raises
    ------
    FileError
        Not TOML, unknown keys, values of other types.
    """
    return _read(description_file(network), NetworkDescription, NetworkDescription())


def _read(file: Path, kind: Any, default: Any) -> Any:
    if not file.is_file():
        return default
    raw = parse_toml(read_text(file, "what describes a network", remedy="Give a text file in UTF-8."), file)
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        what, _, place = str(error).partition(" - at `$")
        keys = ", ".join(kind.__struct_fields__)
        raise FileError(what, file=file, place=place.strip("`.") or None, remedy=f"Its keys are {keys}.") from error


@dataclass(frozen=True, kw_only=True)
class NetworkFormat(Extension):
    """A kind of landmark network of another distribution.

    Parameters
    ----------
    suffixes : ends of the names of its files, in lower case, ".pt"
    load : (path, threads) -> `CropPoints`, with its layout: (network, `PointLayout`)
    """

    suffixes: tuple[str, ...]
    load: Callable[[Path, int], tuple[CropPoints, PointLayout]]


NETWORKS = Extensions("kinefit.networks", NetworkFormat, "landmark network")
"""Kinds of networks of plug-ins; ONNX and BlazePose's TensorFlow Lite are kinefit's own."""


def is_blazepose(network: Path) -> bool:
    """Whether a file is read as BlazePose's TensorFlow Lite: neither ONNX nor of a plug-in."""
    return network.suffix.lower() != ".onnx" and _plugin(network) is None


def _plugin(network: Path) -> NetworkFormat | None:
    found = (NETWORKS.get(name) for name in NETWORKS.names())
    return next((one for one in found if network.name.lower().endswith(one.suffixes)), None)


def open_points(network: Path, threads: int = 1) -> tuple[CropPoints, PointLayout]:
    """A landmark network and the layout of its points; of ONNX, or of a plug-in.

    Raises
    ------
    ObservationError
        The extra `onnx` is not installed.
    FileError
        As `OnnxNetwork`, `recognised` and `read_description`; points of which nothing tells the names.
    PluginError
        A plug-in failed, or returned something else.
    """
    plugin = _plugin(network)
    if plugin is not None:
        found: tuple[CropPoints, PointLayout] = plugin.call(
            "load", network, threads, what="a network and its PointLayout",
            valid=lambda one: isinstance(one, tuple) and len(one) == 2 and isinstance(one[1], PointLayout),
        )  # fmt: skip
        return found
    stated = read_description(network)
    points = networks.OnnxPoints(networks.OnnxNetwork(network, threads, stated.size), stated.values, stated.outputs)
    keypoint_set, names = _names(network, stated, points.count)
    layout = PointLayout(keypoint_set, names, points.network.size)
    if not stated.mapping:
        return points, layout
    return _Some(points, np.array([stated.mapping[name] for name in names])), layout


@dataclass(frozen=True, eq=False)
class _Some:
    """Points of a network in another order, or some of them."""

    points: networks.OnnxPoints
    order: NDArray

    def __call__(self, crop: NDArray[np.uint8]) -> tuple[NDArray, NDArray]:
        found, confidence = self.points(crop)
        return found[self.order], confidence[self.order]


def _names(network: Path, stated: NetworkDescription, count: int) -> tuple[str, tuple[str, ...]]:
    """Set and names of a network's points."""
    file, points = description_file(network), stated.points
    if points is None:
        sets = {len(KEYPOINT_SETS[name]): name for name in _SETS}
        if count not in sets:
            problem = f"{count} points, of which nothing tells the names"
            remedy = f'Write points = ["...", ...] into {file.name} beside it, a name or the name of a set.'
            if count == HAND_POINTS:
                problem, remedy = f"{count} points, as of one hand", "kinefit finds hands by itself: --hands."
            raise FileError(problem, file=network, remedy=remedy)
        points = sets[count]
    if isinstance(points, str):
        check_choice("keypoint set", points, KEYPOINT_SETS, FileError, file=file, place="points", remedy=_CORRECT)
        keypoint_set, names = points, KEYPOINT_SETS[points]
    else:
        sets_of = (name for name, known in KEYPOINT_SETS.items() if set(points) <= set(known))
        keypoint_set, names = next(sets_of, ""), tuple(points)
    if stated.mapping:
        for name, k in stated.mapping.items():
            check_choice("point", name, names, FileError, file=file, place="mapping", remedy=_CORRECT)
            if k >= count:
                raise FileError(
                    f"{name} is point {k} of {count}", file=file, place="mapping", remedy="Count them from 0."
                )
        return keypoint_set, tuple(name for name in names if name in stated.mapping)
    if len(names) != count or len(set(names)) < count:
        problem = f"{len(set(names))} different names for a network of {count} points"
        raise FileError(problem, file=file, place="points", remedy="Name each once, in its order, or add a mapping.")
    return keypoint_set, names


def open_people(network: Path, threads: int = 1, aspect: float = 1.0) -> networks.BoxPeople:
    """A detector of people: YOLOX or RTMDet as ONNX; raises as `BoxPeople`, `OnnxNetwork` and `read_description`.

    `aspect`: height to width of the crops in which points are then looked for.
    """
    stated = read_description(network)
    values = stated.values if stated.mean or stated.std or stated.colours or stated.scale != 1.0 else None
    return networks.BoxPeople(networks.OnnxNetwork(network, threads, stated.size), values, aspect)


class NetworkSigma(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Standard deviation of a network's points by their confidence; what NETWORK.sigma.toml states.

    Parameters
    ----------
    confidence : increasing
    sigma : the same number, falling, shares of the extent of a person's points in the image; linear in between
    points : {name: factor of a point's own}; 1 for others
    """

    confidence: list[Annotated[float, msgspec.Meta(ge=0, le=1)]]
    sigma: list[_Scale]
    points: dict[str, _Scale] = {}

    def __post_init__(self) -> None:
        if not 0 < len(self.confidence) == len(self.sigma):
            raise ValueError("as many numbers of confidence as of sigma are expected")
        if np.any(np.diff(self.confidence) <= 0) or np.any(np.diff(self.sigma) > 0):
            raise ValueError("confidence has to increase, and sigma to fall")

    def of(self, confidence: NDArray, names: Sequence[str]) -> NDArray:
        """(..., K) shares of a person's extent, of confidences (..., K) of points (K,)."""
        factors = np.array([self.points.get(name, 1.0) for name in names])
        return np.asarray(np.interp(confidence, self.confidence, self.sigma) * factors)

    def calibrated(self, record: Keypoints, count: int) -> Keypoints:
        """The record with its standard deviation [px] at confidence 1, and the confidences that are right beside it.

        `count`: of its points that are the network's, the first ones.
        """
        names, extent = record.names[:count], extent_px(record.points[..., :count, :], record.confidence[..., :count])
        best = float(self.of(np.ones(count), names).min())
        if not np.isfinite(extent).any():
            return record
        confidence, own = np.array(record.confidence), record.confidence[..., :count]
        confidence[..., :count] = np.where(own > 0, (best / self.of(own, names)) ** 2, 0.0)
        return replace(record, confidence=confidence, sigma=best * float(np.nanmedian(extent)))


def extent_px(points: NDArray, confidence: NDArray) -> NDArray:
    """(F, P) [px] extent of people's points (F, P, K, 2) of a confidence (F, P, K) above 0.3; NaN where unseen."""
    seen = (confidence > 0.3)[..., None] & np.isfinite(points)
    extent = np.max(np.where(seen, points, -np.inf), axis=2) - np.min(np.where(seen, points, np.inf), axis=2)
    return np.where(np.isfinite(extent).all(axis=-1), extent.max(axis=-1), np.nan)


def sigma_file(network: Path) -> Path:
    """The file beside a network that states how exact it is."""
    return network.with_suffix(".sigma.toml")


def read_sigma(network: Path) -> NetworkSigma | None:
    """How exact a network is; None where that was not calibrated. FileError for a file that does not state it."""
    found: NetworkSigma | None = _read(sigma_file(network), NetworkSigma, None)
    return found


def write_sigma(found: NetworkSigma, network: Path) -> Path:
    """Write how exact a network is beside it; returns the file."""
    def listed(values: Sequence[float]) -> str:
        return f"[{', '.join(f'{v:.5g}' for v in values)}]"

    text = "# Standard deviation of this network's points by their confidence, in extents of a person's points.\n"
    file = sigma_file(network)
    text += f"confidence = {listed(found.confidence)}\nsigma = {listed(found.sigma)}\n\n[points]\n"
    text += "".join(f"{json.dumps(name)} = {factor:.4g}\n" for name, factor in found.points.items())
    write_text(file, text)
    return file
