"""Points of ONNX networks beside onnxruntime and the published decoding, written apart here; and what that costs.

Random images of one person's region, in networks of colours with random blur: points in the image. The published way is
MMPose's: `(x - mean) / std` of an affine crop, the largest bin of SimCC over its split ratio, or the largest cell of a
heatmap and a quarter of a cell towards the larger neighbour, `point / size * scale + centre - scale / 2`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import NotMeasured, amount, figure
from kinefit.images.detectors.roi import Roi
from kinefit.readers.landmarks.networks import open_points

_MEAN, _STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
_SIZE = 192, 256
_GFLOPS = 1.9  # of RTMPose-m


def run() -> None:
    """Print the figures."""
    try:
        from benchmarks.accuracy.detection.onnx_networks import heatmap_network, simcc_network
    except ImportError as error:
        raise NotMeasured(f"no onnxruntime ({error})") from error
    with tempfile.TemporaryDirectory() as folder:
        for name, make, decode in (("simcc", simcc_network, _simcc), ("heatmaps", heatmap_network, _heatmaps)):
            figure(f"networks_decode_{name}", _difference(make(Path(folder) / f"{name}.onnx"), decode), "px", "<= 0.01")
        shares = [_cost(_large(Path(folder) / f"large_{name}.onnx", name)) for name in ("simcc", "heatmaps")]
        figure("networks_cost", max(shares), "of the network's own run", "<= 0.1")


def _difference(file: Path, decode: Callable[[list[NDArray]], NDArray]) -> float:
    """Largest distance [px] of kinefit's points in an image from the published ones."""
    import onnxruntime

    find, layout = open_points(file)
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(amount(40, 4)):
        noise = rng.integers(0, 256, (24, 32, 3), np.uint8)
        image = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
        centre, height = rng.uniform([150, 150], [490, 330]), rng.uniform(150, 500)
        roi = Roi(centre, float(height), 0.0)
        points = roi.to_image(find(roi.crop(image, layout.size, cv2.BORDER_CONSTANT))[0], layout.size)
        scale = np.array([height * _SIZE[0] / _SIZE[1], height])
        corners = np.array([[0, 0], [0, _SIZE[1]], [_SIZE[0], 0]], np.float32)
        there = (corners / _SIZE * scale + centre - scale / 2).astype(np.float32)
        crop = cv2.warpAffine(image, cv2.getAffineTransform(there, corners), _SIZE, flags=cv2.INTER_LINEAR)
        values = ((crop - _MEAN) / _STD).transpose(2, 0, 1)[None].astype(np.float32)
        own = decode(session.run(None, {"image": values}))
        worst = max(worst, float(np.linalg.norm(points - (own / _SIZE * scale + centre - scale / 2), axis=1).max()))
    return worst


def _simcc(outputs: list[NDArray]) -> NDArray:
    """(K, 2) [px of the crop] of MMPose's `get_simcc_maximum`, over the split ratio."""
    x, y = outputs
    return np.stack([np.argmax(x[0], axis=1), np.argmax(y[0], axis=1)], axis=-1) / (x.shape[2] / _SIZE[0])


def _heatmaps(outputs: list[NDArray]) -> NDArray:
    """(K, 2) [px of the crop] of MMPose's `get_heatmap_maximum` and `refine_keypoints`, times the cell's size."""
    points = []
    for heat in outputs[0][0]:
        v, u = np.unravel_index(np.argmax(heat), heat.shape)
        point = np.array([u, v], float)
        if 1 < u + 1 < heat.shape[1] and 1 < v + 1 < heat.shape[0]:
            point[0] += 0.25 * np.sign(heat[v, u + 1] - heat[v, u - 1])
            point[1] += 0.25 * np.sign(heat[v + 1, u] - heat[v - 1, u])
        points.append(point * [_SIZE[0] / heat.shape[1], _SIZE[1] / heat.shape[0]])
    return np.array(points)


def _large(file: Path, name: str) -> Path:
    """A network of random convolutions with as many operations as RTMPose-m."""
    from onnx import TensorProto, helper, numpy_helper

    from benchmarks.accuracy.detection.onnx_networks import save

    rng, width = np.random.default_rng(1), 128
    cells = _SIZE[0] // 8 * _SIZE[1] // 8
    layers = round(_GFLOPS * 1e9 / 2 / (cells * 9 * width**2))  # of multiplications and additions
    weights = {"w": rng.normal(size=(width, 3, 8, 8)) / 14, "k": rng.normal(size=(17, width, 1, 1)) / 12}
    nodes = [helper.make_node("Conv", ["image", "w"], ["x0"], strides=[8, 8])]
    for k in range(layers):
        weights[f"w{k}"] = rng.normal(size=(width, width, 3, 3)) / 24
        nodes += [
            helper.make_node("Conv", [f"x{k}", f"w{k}"], [f"c{k}"], pads=[1] * 4),
            helper.make_node("Relu", [f"c{k}"], [f"x{k + 1}"]),
        ]
    nodes += [helper.make_node("Conv", [f"x{layers}", "k"], ["few"])]
    if name == "heatmaps":
        weights["twice"] = np.array([1, 1, 2, 2])
        nodes.append(helper.make_node("Resize", ["few", "", "twice"], ["heatmaps"], mode="nearest"))
        shapes = {"heatmaps": [1, 17, 64, 48]}
    else:
        shapes = {}
        for out, axis, length in (("simcc_x", 2, _SIZE[0] * 2), ("simcc_y", 3, _SIZE[1] * 2)):
            weights[f"{out}_axis"], weights[f"{out}_by"] = np.array([axis]), np.array([1, 1, 16])
            nodes.append(helper.make_node("ReduceSum", ["few", f"{out}_axis"], [f"{out}_sum"], keepdims=0))
            nodes.append(helper.make_node("Resize", [f"{out}_sum", "", f"{out}_by"], [out], mode="nearest"))
            shapes[out] = [1, 17, length]
    arrays = [
        numpy_helper.from_array(np.asarray(v, np.int64 if n.endswith("axis") else np.float32), n)
        for n, v in weights.items()
    ]
    outputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in shapes.items()]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, _SIZE[1], _SIZE[0]])
    return save(helper.make_graph(nodes, "large", [image], outputs, arrays), file)


def _cost(file: Path) -> float:
    """What kinefit adds to a network's run: crop, input and decoding, as a share of it; medians of pairs."""
    import onnxruntime

    find, layout = open_points(file)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (1080, 1920, 3), np.uint8)
    values = rng.normal(size=(1, 3, _SIZE[1], _SIZE[0])).astype(np.float32)
    roi = Roi(np.array([900.0, 500.0]), 700.0, 0.0)
    spent = np.empty((amount(60, 5), 2))
    for own in spent:
        begin = time.process_time()
        session.run(None, {"image": values})
        middle = time.process_time()
        find(roi.crop(image, layout.size, cv2.BORDER_CONSTANT))
        own[:] = middle - begin, time.process_time() - middle
    run_s, whole_s = np.median(spent, axis=0)
    print(f"# {file.stem}: network {1e3 * run_s:.1f} ms, with crop and decoding {1e3 * whole_s:.1f} ms of processor")
    return float(whole_s / run_s - 1)
