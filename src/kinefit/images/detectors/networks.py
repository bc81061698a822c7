"""Networks of ONNX files: landmarks of a person in an upright crop (SimCC, heatmaps), and boxes of people.

Sources: MMPose 1.3, `GetBBoxCenterScale` and `TopdownAffine` (crop), `SimCCLabel` and `MSRAHeatmap` (decoding); Li et
al., SimCC, ECCV 2022; Xiao et al., Simple baselines, ECCV 2018; Ge et al., YOLOX, 2021; Lyu et al., RTMDet, 2022.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, ObservationError, extra
from kinefit.images.detectors.box_detector import DetectedPerson
from kinefit.images.detectors.layouts import PointLayout
from kinefit.images.detectors.roi import PersonLandmarks, mean_with_mirrored

IMAGENET_MEAN, IMAGENET_STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
"""Of red, green and blue, 0 to 255: what MMPose's networks and ViTPose are trained with."""

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_MAX_SIDE_PX = 4096  # of an input: larger ones are no crops of a person
_BOX_SIDES = 1.25  # box of a person to that of the points, which lie within the body: that of rtmlib's tracker
_POINT_SHARE = 0.5  # of the points, the surest, whose mean confidence is the score of a person: half a body in view


@dataclass(frozen=True)
class CropInput:
    """What becomes of an RGB image before a network sees it: (pixel * scale - mean) / std, planes after each other.

    Parameters
    ----------
    mean, std : (3,) of red, green and blue
    colours : "RGB" or "BGR", the order of the planes
    scale : factor of pixels 0 to 255
    """

    mean: Sequence[float] = IMAGENET_MEAN
    std: Sequence[float] = IMAGENET_STD
    colours: str = "RGB"
    scale: float = 1.0

    def __call__(self, image: NDArray[np.uint8], dtype: Any = np.float32) -> NDArray:
        """(1, 3, H, W) of an RGB image (H, W, 3)."""
        gain = np.float32(self.scale) / np.asarray(self.std, np.float32)
        shift = np.asarray(self.mean, np.float32) / np.asarray(self.std, np.float32)
        planes = cv2.split(image)
        order = range(3) if self.colours == "RGB" else (2, 1, 0)
        values = np.stack([planes[k] * gain[k] - shift[k] for k in order])
        return np.ascontiguousarray(values[None], dtype)


RAW = CropInput((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), "BGR")
"""Of YOLOX: pixels as they are."""


class OnnxNetwork:
    """A network with one image as its input.

    Parameters
    ----------
    path : Path
    threads : int
    size : (width, height) [px] of an input of any size

    Raises
    ------
    ObservationError
        The extra `onnx` is not installed.
    FileError
        Missing, no ONNX file, operators that the runtime lacks, no input (N, 3, H, W) of real numbers of known size.
    """

    def __init__(self, path: Path, threads: int = 1, size: tuple[int, int] | None = None) -> None:
        with extra("onnx", "ONNX networks are run by the package onnxruntime", ObservationError):
            import onnxruntime as runtime
        self.path = path
        if not path.is_file():
            raise FileError("no such network", file=path, remedy="Check its name.")
        with path.open("rb") as file:
            if file.read(1) in (b"", b"\0"):  # no field of an ONNX file has the number 0
                raise FileError("not an ONNX file", file=path, remedy="Export the network to ONNX, or copy it anew.")
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = threads, 4
        try:
            self._session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # the runtime's errors have no base of their own
            message = " ".join(str(error).split())[:300]
            remedy = "Export it anew for the installed onnxruntime, without operators of other runtimes."
            raise FileError(f"not a network that onnxruntime runs ({message})", file=path, remedy=remedy) from error
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        if len(shape) != 4 or shape[1] != 3 or (shape[0] not in (1, None) and not isinstance(shape[0], str)):
            listed = ", ".join(f"{one.name} {list(one.shape)}" for one in inputs)
            problem = f"its inputs are {listed}, not one image (1, 3, height, width)"
            raise FileError(problem, file=path, remedy="Export it with one image as the input, its colours first.")
        if inputs[0].type not in _TYPES:
            remedy = "Export it with an input of float32 or float16."
            raise FileError(f"its input is a {inputs[0].type}", file=path, remedy=remedy)
        self._name, self.dtype = inputs[0].name, _TYPES[inputs[0].type]
        stated = [n if isinstance(n, int) and n > 0 else None for n in (shape[3], shape[2])]
        self.size: tuple[int, int] = tuple(n or m for n, m in zip(stated, size or (0, 0)))  # type: ignore[assignment]
        if not 0 < min(self.size) <= max(self.size) <= _MAX_SIDE_PX:
            problem = f"its input has no size of its own {shape}" if not min(self.size) else f"an input of {self.size}"
            remedy = f"Write size = [width, height] in pixels into {path.with_suffix('.toml').name} beside it."
            raise FileError(problem, file=path, remedy=remedy)

    def run(self, values: NDArray, names: Sequence[str] | None = None) -> dict[str, NDArray]:
        """{name: output}, as float32, of an input (1, 3, H, W); of some outputs, or all.

        Raises
        ------
        FileError
            The runtime failed; an output is no array of numbers.
        """
        names = list(names) if names else [one.name for one in self._session.get_outputs()]
        try:
            found = self._session.run(names, {self._name: values})
            return {name: np.asarray(one, np.float32) for name, one in zip(names, found)}
        except Exception as error:  # as above
            message = " ".join(str(error).split())[:300]
            raise FileError(f"it cannot be run ({message})", file=self.path, remedy="Check the export.") from error

    def grey(self, values: CropInput) -> NDArray:
        """An input of a grey image."""
        return values(np.full((self.size[1], self.size[0], 3), 114, np.uint8), self.dtype)


@dataclass(frozen=True)
class SimCC:
    """Points from their likeness along both axes: (1, K, W s) and (1, K, H s), s bins a pixel; the largest bin counts.

    The confidence is the smaller of both largest values. Source: MMPose's `get_simcc_maximum`, without DARK.
    """

    x: str
    y: str
    bins: float

    def __call__(self, outputs: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Points (K, 2) [px of the crop] and confidence (K,)."""
        along = outputs[self.x][0], outputs[self.y][0]
        points = np.stack([one.argmax(axis=1) for one in along], axis=1) / self.bins
        return points, np.minimum(*(one.max(axis=1) for one in along))


@dataclass(frozen=True)
class Heatmaps:
    """Points from their likeness over the crop (1, K, h, w): the largest cell, a quarter of one towards the next.

    Source: MMPose's `MSRAHeatmap` with `refine_keypoints`, without DARK.
    """

    name: str
    stride: tuple[float, float]

    def __call__(self, outputs: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Points (K, 2) [px of the crop] and confidence (K,)."""
        maps = outputs[self.name][0]
        count, height, width = maps.shape
        flat = maps.reshape(count, -1)
        v, u = np.divmod(flat.argmax(axis=1), width)
        k, inner = np.arange(count), (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
        left, right = maps[k, v, np.maximum(u - 1, 0)], maps[k, v, np.minimum(u + 1, width - 1)]
        above, below = maps[k, np.maximum(v - 1, 0), u], maps[k, np.minimum(v + 1, height - 1), u]
        towards = np.sign(np.stack([right - left, below - above], axis=1)) * inner[:, None]
        return (np.stack([u, v], axis=1) + 0.25 * towards) * self.stride, flat.max(axis=1)


_OTHER_KINDS = "Give a network of one person in a crop: SimCC as RTMPose has it, or heatmaps as HRNet and ViTPose."


def recognised(network: OnnxNetwork, outputs: dict[str, NDArray]) -> tuple[SimCC | Heatmaps, int]:
    """How a network's outputs are decoded, and the number of its points.

    Raises
    ------
    FileError
        Outputs of another kind of network, which is named where it is known.
    """
    (W, H), shapes = network.size, {name: one.shape for name, one in outputs.items()}
    names, listed = list(shapes), ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    if len(shapes) == 2 and all(len(s) == 3 and s[:2] == shapes[names[0]][:2] for s in shapes.values()):
        for x, y in (names, names[::-1]):
            bins = shapes[x][2] / W
            if bins >= 1 and bins == shapes[y][2] / H:
                return SimCC(x, y, bins), shapes[x][1]
    if len(shapes) == 1 and len(shapes[names[0]]) == 4:
        _, K, h, w = shapes[names[0]]
        if (h, w) != (H, W) and 1 < W / w == H / h:
            return Heatmaps(names[0], (W / w, H / h)), K
    what, remedy = _other_kind(network, shapes)
    raise FileError(f"{what}: its outputs are {listed} for a crop of {W} x {H} px", file=network.path, remedy=remedy)


def _other_kind(network: OnnxNetwork, shapes: dict[str, tuple[int, ...]]) -> tuple[str, str]:
    """What a network is that gives no points of a crop, and what to do."""
    (W, H), dims = network.size, sorted(shapes.values(), key=len)
    if len(dims) == 1 and len(dims[0]) == 4 and dims[0][2:] == (H, W):
        return "a network that segments images", _OTHER_KINDS
    if any(len(shape) == 4 and shape[-1] in (2, 3) for shape in dims):
        return "a one-stage network, as RTMO is", _OTHER_KINDS
    if len(dims) == 1 and len(dims[0]) == 3 and (min(dims[0][1:]) in (6, 85) or dims[0][2] in (6, 85)):
        return "a detector of boxes", "Give it as --detector; --network finds the points of a person."
    if len(dims) == 1 and len(dims[0]) == 3 and min(dims[0][1:]) > 6 and (min(dims[0][1:]) - 5) % 3 == 0:
        return "a one-stage network, as YOLO-pose is", _OTHER_KINDS
    if len(dims) == 2 and len(dims[1]) == 3 and dims[1][2] == 5:
        return "a detector of boxes", "Give it as --detector; --network finds the points of a person."
    return "no known network of points", _OTHER_KINDS


class CropPoints(Protocol):
    """A network that finds a person's points in a crop: what entry points of other distributions give."""

    def __call__(self, crop: NDArray[np.uint8]) -> tuple[NDArray, NDArray]:
        """Points (K, 2) [px of the crop] and confidence (K,) 0..1 of an RGB crop (height, width, 3)."""
        ...


class OnnxPoints:
    """Finds a person's points in a crop by an ONNX network.

    Parameters
    ----------
    network : OnnxNetwork
    values : CropInput
    outputs : names of the outputs that count; default: all
    """

    def __init__(self, network: OnnxNetwork, values: CropInput, outputs: Sequence[str] | None = None) -> None:
        self.network, self._values, self._outputs = network, values, outputs
        self._decode, self.count = recognised(network, network.run(network.grey(values), outputs))

    def __call__(self, crop: NDArray[np.uint8]) -> tuple[NDArray, NDArray]:
        """Points (K, 2) [px of the crop] and confidence (K,) of an RGB crop (height, width, 3)."""
        points, score = self._decode(self.network.run(self._values(crop, self.network.dtype), self._outputs))
        return points, np.clip(np.nan_to_num(score, nan=0.0), 0.0, 1.0)


class TopDownModels:
    """A detector of people, and a network of the points of one in an upright crop; as `Models`, without masks.

    Parameters
    ----------
    points : CropPoints
    layout : PointLayout of its points and crop
    people : with methods `__call__` and `search` of `PersonDetector`
    mirrored : bool
        Each crop is evaluated a second time, mirrored, and both results are averaged.
    """

    def __init__(self, points: CropPoints, layout: PointLayout, people: Any, *, mirrored: bool = False) -> None:
        self.layout, self._points, self._people, self._mirrored = layout, points, people, mirrored

    def find_people(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """Detect people in an image (H, W, 3) RGB, in order of decreasing score."""
        return [_upright(person) for person in self._people(image)]

    def search(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """Detect people in its tiles, too, and where the camera lies on its side."""
        return [_upright(person) for person in self._people.search(image)]

    def pose(self, crop: NDArray[np.uint8], *, mask: bool = True) -> PersonLandmarks:
        """Landmarks of the person in an RGB crop of the layout's size, without a mask."""
        seen = self._seen(crop)
        if not self._mirrored:
            return seen
        return mean_with_mirrored(seen, self._seen(np.ascontiguousarray(crop[:, ::-1])), self.layout)

    def _seen(self, crop: NDArray[np.uint8]) -> PersonLandmarks:
        points, confidence = self._points(crop)
        sure = confidence >= self.layout.limits[1]
        box = points[sure] if sure.sum() > 1 else points
        low, high = box.min(axis=0), box.max(axis=0)
        middle, (width, height) = (low + high) / 2, _BOX_SIDES * (high - low)
        rim = middle - [0.0, max(height, width * self.layout.size[1] / self.layout.size[0], 1.0) / 2]
        best = np.sort(confidence)[-max(round(_POINT_SHARE * len(confidence)), 1) :]
        return PersonLandmarks(
            points, confidence, np.ones_like(confidence), middle, rim, float(best.mean()), None, None
        )


def _upright(person: DetectedPerson) -> DetectedPerson:
    """A person whose region is turned by quarter turns alone, as the networks were trained."""
    middle, rim = person.points
    up, axis = np.zeros(2), int(np.abs(rim - middle).argmax())
    up[axis] = np.copysign(np.linalg.norm(rim - middle), (rim - middle)[axis])
    return DetectedPerson(np.stack([middle, middle + up]), person.score, person.head)


_MIN_BOX_SCORE = 0.3  # of MMPose's demonstrations
_MAX_BOX_OVERLAP = 0.45  # intersection over union, as YOLOX publishes it
_STRIDES = 8, 16, 32  # [px] of YOLOX's feature maps
_COLUMNS = 85, 6  # of YOLOX: box, score of any object, of 80 kinds of COCO or of people alone
_FILL = 114  # grey beside the image, as YOLOX and RTMDet are trained


class BoxPeople:
    """Finds people by an ONNX detector of boxes: YOLOX (1, A, 85 or 6), or with its last steps (1, M, 5) and labels.

    Parameters
    ----------
    network : OnnxNetwork
    values : CropInput; default: pixels as they are for YOLOX, `IMAGENET_MEAN` for RTMDet
    aspect : height to width of the crops in which the points are looked for

    Raises
    ------
    FileError
        Outputs of another network.
    """

    def __init__(self, network: OnnxNetwork, values: CropInput | None, aspect: float) -> None:
        self._network, self._aspect = network, aspect
        shapes = [one.shape for one in network.run(network.grey(values or RAW)).values()]
        W, H = network.size
        cells = sum((W // s) * (H // s) for s in _STRIDES)
        whole = len(shapes) == 1 and len(shapes[0]) == 3 and shapes[0][1] == cells and shapes[0][2] in _COLUMNS
        short = len(shapes) == 2 and sorted(map(len, shapes)) == [2, 3] and any(s[2:] == (5,) for s in shapes)
        if not whole and not short:
            problem = f"no detector of people: its outputs are {', '.join(map(str, shapes))}"
            remedy = f"Give YOLOX (1, {cells}, 85 or 6), or RTMDet's (1, M, 5) boxes with (1, M) labels."
            raise FileError(problem, file=network.path, remedy=remedy)
        self._decode: Callable[[dict[str, NDArray]], tuple[NDArray, NDArray]] = self._yolox if whole else self._rtmdet
        self._values = values or (RAW if whole else CropInput(colours="BGR"))

    def __call__(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """People in an RGB image (H, W, 3), in order of decreasing score."""
        (W, H), (height, width) = self._network.size, image.shape[:2]
        ratio = min(W / width, H / height)
        padded = np.full((H, W, 3), _FILL, np.uint8)
        small = cv2.resize(image, (int(width * ratio), int(height * ratio)), interpolation=cv2.INTER_LINEAR)
        padded[: small.shape[0], : small.shape[1]] = small
        boxes, scores = self._decode(self._network.run(self._values(padded, self._network.dtype)))
        sizes = [[float(u), float(v), float(w - u), float(h - v)] for u, v, w, h in boxes]
        kept = cv2.dnn.NMSBoxes(sizes, scores.tolist(), _MIN_BOX_SCORE, _MAX_BOX_OVERLAP) if len(sizes) else ()
        return [self._person(boxes[k] / ratio, float(scores[k])) for k in np.ravel(kept).astype(int)]

    def search(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """The same: it finds small people in the whole image."""
        return self(image)

    def _person(self, box: NDArray, score: float) -> DetectedPerson:
        (u0, v0, u1, v1), middle = box, (box[:2] + box[2:]) / 2
        radius = max(v1 - v0, (u1 - u0) * self._aspect) / 2
        return DetectedPerson(np.stack([middle, middle - [0.0, radius]]), score)

    def _yolox(self, outputs: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """Boxes (M, 4) [px of the input] and scores (M,): people are the first kind of objects."""
        (raw,), (W, H) = outputs.values(), self._network.size
        grids = [np.stack(np.meshgrid(np.arange(W // s), np.arange(H // s)), -1).reshape(-1, 2) for s in _STRIDES]
        stride = np.repeat(_STRIDES, [len(grid) for grid in grids])[:, None]
        scores = raw[0, :, 4] * raw[0, :, 5]
        kept = scores > _MIN_BOX_SCORE
        centre = ((raw[0, :, :2] + np.concatenate(grids)) * stride)[kept]
        half = (np.exp(np.minimum(raw[0, :, 2:4], 10.0)) * stride)[kept] / 2
        return np.concatenate([centre - half, centre + half], axis=1), scores[kept]

    def _rtmdet(self, outputs: dict[str, NDArray]) -> tuple[NDArray, NDArray]:
        """As `_yolox`, of boxes that the network has chosen; label 0 is a person."""
        labels, boxes = sorted((one[0] for one in outputs.values()), key=lambda one: one.ndim)
        people = boxes[(labels == 0) & (boxes[:, 4] > _MIN_BOX_SCORE)]
        return people[:, :4], people[:, 4]
