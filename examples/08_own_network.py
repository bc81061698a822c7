"""A landmark network of one's own, as a plug-in gives it: here it finds discs by their colours, without a runtime.

A package names NETWORK in its entry points; `kinefit detect --network FILE.colours` then uses it:
    [project.entry-points."kinefit.networks"]
    colours = "my_package:NETWORK"
    python examples/08_own_network.py
"""

from pathlib import Path

import cv2
import numpy as np

from kinefit.readers import NetworkFormat, PointLayout

LAYOUT = PointLayout("COCO_17", ("Nose", "LWrist", "RWrist"), size=(192, 256))  # some of a set, in the network's order
NEAR = 60.0  # distance of colours at which half of the confidence is left


class ColourNetwork:
    def __init__(self, path):  # a file of one colour a line: red green blue
        self.colours = np.loadtxt(path, ndmin=2)

    def __call__(self, crop):
        """Points (K, 2) [px] and confidence (K,) 0..1 in an RGB crop of the layout's size."""
        points, confidence = [], []
        for colour in self.colours:
            like = cv2.GaussianBlur(0.5 ** (np.linalg.norm(crop - colour, axis=2) / NEAR), (0, 0), 2.0)
            v, u = np.unravel_index(like.argmax(), like.shape)
            points.append((u, v))
            confidence.append(like[v, u])
        return np.array(points, float), np.array(confidence)


def load(path, threads):
    return ColourNetwork(path), LAYOUT


NETWORK = NetworkFormat(summary="points by their colours", suffixes=(".colours",), load=load)


def main(file="discs.colours"):
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]])
    np.savetxt(file, colours, fmt="%d")
    truth = np.array([[96.0, 40.0], [30.0, 120.0], [160.0, 130.0]])
    crop = np.zeros((256, 192, 3), np.uint8)
    for point, colour in zip(truth, colours):
        cv2.circle(crop, point.astype(int).tolist(), 5, colour.tolist(), -1)
    find, layout = NETWORK.load(Path(file), 1)
    points, confidence = find(crop)
    off = np.linalg.norm(points - truth, axis=1)
    for name, pixels, sure in zip(layout.names, off, confidence):
        print(f"{name}: {pixels:.1f} px off, confidence {sure:.2f}")
    return off, confidence


if __name__ == "__main__":
    main()
