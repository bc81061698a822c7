"""Small ONNX networks that find points by their colours, of the kinds that `kinefit detect --network` takes."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLOURS = np.array([c for c in product((0, 128, 255), repeat=3) if max(c) == 255], float)  # of red, green and blue
_MEAN, _STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
_LIKE = 0.25  # squared distance of colours, in the network's units, at which the likeness is 1/e
_SIGMA_PX = 3.0  # of the blur that makes a disc a peak


def heatmap_network(path: Path, count: int = 17, size: Any = (192, 256), stride: int = 4, **more: Any) -> Path:
    """Heatmaps (N, K, H / stride, W / stride) of the likeness to each point's colour."""
    from onnx import helper

    w, h = (n // stride if isinstance(n, int) else f"{n}_map" for n in size)
    nodes = [helper.make_node(
        "AveragePool", ["smooth"], ["heatmaps"], kernel_shape=[stride] * 2, strides=[stride] * 2
    )]  # fmt: skip
    return _written(path, nodes, {"heatmaps": ["N", count, h, w]}, count, size, **more)


def simcc_network(path: Path, count: int = 17, size: Any = (192, 256), bins: int = 2, **more: Any) -> Path:
    """SimCC (N, K, W bins) and (N, K, H bins): likeness summed over the other axis."""
    from onnx import helper

    nodes, outputs = [], {}
    for name, axis, length in (("simcc_x", "rows", size[0]), ("simcc_y", "columns", size[1])):
        nodes.append(helper.make_node("ReduceSum", ["smooth", axis], [f"{name}_sum"], keepdims=0))
        nodes.append(helper.make_node("Mul", [f"{name}_sum", "share"], [f"{name}_share"]))
        nodes.append(helper.make_node("Resize", [f"{name}_share", "", "bins"], [name], mode="linear"))
        outputs[name] = ["N", count, length * bins if isinstance(length, int) else f"{length}_bins"]
    more["constants"] = {
        "rows": np.array([2]), "columns": np.array([3]), "share": np.float32(0.3),
        "bins": np.array([1, 1, bins], np.float32),
    }  # fmt: skip
    return _written(path, nodes, outputs, count, size, **more)


def _written(
    path: Path, nodes: list[Any], outputs: dict[str, list[Any]], count: int, size: Any, *, half: bool = False,
    constants: dict[str, Any] | None = None, domain: str = "",
) -> Path:  # fmt: skip
    """A network from an image by likeness and blur to `nodes`; `domain` of an operator that no runtime has."""
    from onnx import TensorProto, helper, numpy_helper

    wanted = ((COLOURS[:count] - _MEAN) / _STD).astype(np.float32)
    u = np.arange(-6, 7)
    kernel = np.exp(-(u[:, None] ** 2 + u**2) / (2 * _SIGMA_PX**2)).astype(np.float32)
    weights = {
        "twice": 2 / _LIKE * wanted[:, :, None, None], "less": -(wanted**2).sum(axis=1) / _LIKE,
        "kernel": np.tile(kernel / kernel.max() / 40, (count, 1, 1, 1)), "channels": np.array([1]),
        "minus": np.float32(-1 / _LIKE), **(constants or {}),
    }  # fmt: skip
    node = helper.make_node
    begin = [
        node("Cast", ["image"], ["values"], to=TensorProto.FLOAT),
        node("Conv", ["values", "twice", "less"], ["product"]), node("Mul", ["values", "values"], ["squares"]),
        node("ReduceSum", ["squares", "channels"], ["square"], keepdims=1), node("Mul", ["square", "minus"], ["own"]),
        node("Add", ["product", "own"], ["closeness"]), node("Exp", ["closeness"], ["likeness"]),
        node("Conv", ["likeness", "kernel"], ["smooth"], group=count, pads=[6] * 4),
    ]  # fmt: skip
    if domain:
        begin.append(node("Absent", ["smooth"], ["other"], domain=domain))
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    graph = helper.make_graph(
        [*begin, *nodes], "by colour", [helper.make_tensor_value_info("image", kind, ["N", 3, size[1], size[0]])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()],
    )  # fmt: skip
    return save(graph, path, domain)


def save(graph: Any, path: Path, domain: str = "") -> Path:
    """Write a graph of ONNX as a file."""
    import onnx
    from onnx import helper

    opsets = [helper.make_opsetid("", 17), *([helper.make_opsetid(domain, 1)] if domain else [])]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), str(path))
    return path


def constant_network(path: Path, outputs: dict[str, NDArray], size: Any = (192, 256), gain: float = 0.0) -> Path:
    """A network of the same outputs for every image; with a `gain`, scores of boxes by the image's brightest value."""
    from onnx import TensorProto, helper, numpy_helper

    nodes = [
        helper.make_node("ReduceMax", ["image"], ["bright"], keepdims=0),
        helper.make_node("Mul", ["bright", "gain"], ["lit"]),
    ]
    weights, infos = {"gain": np.array(gain, np.float32)}, []
    for name, value in outputs.items():
        weights[f"{name}_value"] = value
        scores = np.zeros(value.shape, np.float32)
        scores[..., 4:5] = gain > 0
        if scores.any():
            weights[f"{name}_lit"], weights[f"{name}_always"] = scores * value, value * (1 - scores)
            nodes.append(helper.make_node("Mul", [f"{name}_lit", "lit"], [f"{name}_of"]))
            nodes.append(helper.make_node("Add", [f"{name}_of", f"{name}_always"], [name]))
        else:
            nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
        of = TensorProto.FLOAT if value.dtype == np.float32 else TensorProto.INT64
        infos.append(helper.make_tensor_value_info(name, of, value.shape))
    image = [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, size[1], size[0]])]
    arrays = [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    return save(helper.make_graph(nodes, "constant", image, infos, arrays), path)


def yolox_network(path: Path, box: tuple[float, float, float, float], size: int = 160, score: float = 0.9) -> Path:
    """YOLOX (1, A, 85): one person in a box (centre u, v, width, height) [px] of images that are not black."""
    cells = [(u, v, s) for s in (8, 16, 32) for v in range(size // s) for u in range(size // s)]
    raw = np.zeros((1, len(cells), 85), np.float32)
    k = next(k for k, (u, v, s) in enumerate(cells) if s == 32 and (u, v) == (2, 2))
    raw[0, k, :6] = box[0] / 32 - 2, box[1] / 32 - 2, np.log(box[2] / 32), np.log(box[3] / 32), 1.0, score
    return constant_network(path, {"output": raw}, (size, size), gain=1 / 255)


def draw(points: NDArray, size: tuple[int, int], radius: int) -> NDArray[np.uint8]:
    """A black RGB image (height, width, 3) with a disc of each point's colour at points (K, 2) [px]."""
    import cv2

    image = np.zeros((size[1], size[0], 3), np.uint8)
    for point, colour in zip(points, COLOURS):
        if np.isfinite(point).all():
            cv2.circle(image, tuple(int(v) for v in np.rint(point)), radius, colour.tolist(), -1, cv2.LINE_AA)
    return image
