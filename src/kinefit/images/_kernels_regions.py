"""Compiled colour histograms inside and outside of a contour, and the likelihood of its position along its normals.

A pixel has one of 32768 colours (five bits a channel). A table maps each colour to its bin, another each bin to the
logarithm of the ratio of the densities inside and outside.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies.rendering._kernels import rasterise

UNKNOWN = 1e6  # in a table of log ratios: not computed yet


@jit
def _colour(image, j, i):
    """Index of a pixel's colour, 0..32767, five bits a channel."""
    return ((image[j, i, 0] >> 3) << 10) | ((image[j, i, 1] >> 3) << 5) | (image[j, i, 2] >> 3)


@jit
def count(image, bins, face, label, left, top, scale, box, inside, near, far):
    """Add pixels of an image (H, W, 3) uint8 to the histograms inside (G, B), and outside near and far (B,).

    face (h, w): the rendered body in a window of the image, the index of a face or below 0. Pixel (x, y) of the image
    lies at ((x - left + 0.5) scale, (y - top + 0.5) scale) of the window. label (T,): body part of each face. Pixels at
    the boundary of a part are not counted. box: left, top, right, bottom [px] of the near region. One pixel in nine is
    sampled inside of it, one in 36 outside.
    """
    height, width = image.shape[:2]
    for y in range(0, height, 6):
        for x in range(0, width, 6):
            if y < box[1] or y >= box[3] or x < box[0] or x >= box[2]:
                far[bins[_colour(image, y, x)]] += 1.0
    margin = math.ceil(2.0 * scale) + 1
    for y in range(max(box[1], 0), min(box[3], height), 3):
        j = math.floor((y - top + 0.5) * scale)
        for x in range(max(box[0], 0), min(box[2], width), 3):
            i = math.floor((x - left + 0.5) * scale)
            if not (-margin <= i < face.shape[1] + margin and -margin <= j < face.shape[0] + margin):
                near[bins[_colour(image, y, x)]] += 1.0
                continue
            here = part(face, label, x, y, left, top, scale)
            if part(face, label, x - 2, y, left, top, scale) != here:
                continue
            if part(face, label, x + 2, y, left, top, scale) != here:
                continue
            if part(face, label, x, y - 2, left, top, scale) != here:
                continue
            if part(face, label, x, y + 2, left, top, scale) != here:
                continue
            if here >= 0:
                inside[here, bins[_colour(image, y, x)]] += 1.0
            elif here == -1:
                near[bins[_colour(image, y, x)]] += 1.0


@jit
def count_lines(image, bins, contour, anchor, reach, face, label, left, top, scale, joined, own, weight, counts):
    """Add the pixels along the normals of a contour (4, N) to the histograms (2, A, B) of its points' anchors (N,).

    weight (2,): of a pixel inside and outside. reach [px]: to either side; the pixel next to the contour is skipped.
    face, label, left, top, scale: see `count`. joined, own (N,): see `profiles`.
    """
    height, width = image.shape[:2]
    for p in range(contour.shape[1]):
        u, v, a, b = contour[0, p], contour[1, p], contour[2, p], contour[3, p]
        a_ = anchor[p]
        for side in range(2):
            sign = 1.0 if side else -1.0
            stays = -1 if side else own[p]
            for k in range(2, reach + 2):
                x, y = u + sign * k * a, v + sign * k * b
                i, j = math.floor(x + 0.5), math.floor(y + 0.5)
                if not (0 <= i < width and 0 <= j < height):
                    break
                here = part(face, label, x, y, left, top, scale)
                if here < -1 or not joined[stays, here]:
                    break
                counts[side, a_, bins[_colour(image, j, i)]] += weight[side]


@jit
def part(face, label, x, y, left, top, scale):
    """Body part that is rendered at a pixel (x, y) of the image: -1 for none, -2 for something in front of the body."""
    i, j = math.floor((x - left + 0.5) * scale), math.floor((y - top + 0.5) * scale)
    if not (0 <= i < face.shape[1] and 0 <= j < face.shape[0]):
        return -1
    f = face[j, i]
    return label[f] if f >= 0 else f


@jit
def _found(table, own, total, general, inner, floor, most, a, b):
    """Compute the log ratio of bin b at anchor a, and store it in `table` (A, B); see `profiles`."""
    inside = (own[0, a, b] + general[inner[a], b]) / total[0, a] + floor
    ratio = math.log(inside / ((own[1, a, b] + general[len(general) - 1, b]) / total[1, a] + floor))
    table[a, b] = most if ratio > most else -most if ratio < -most else ratio
    return table[a, b]


@jit
def profiles(
    image, bins, table, counts, total, general, inner, floor, most, logs, anchor, contour, face, label, left, top,
    scale, joined, own, beyond, half, step, guard, out,
):  # fmt: skip
    """Sample log ratios of inside to outside along the normals of a contour: out (N, 2 half), from inside to outside.

    Sample k is the sum over `step` pixels about (k + 0.5 - half) step [px] along the normal.

    table (A, B): log ratios in -most..most at each anchor; a point uses the row of its anchor (N,).
    counts (2, A, B): pixels inside and outside near each anchor, from which UNKNOWN entries of the table are computed.
    general (G + 1, B): pseudo-counts of each body part and, last, of the outside; added to counts. inner (A,): the part
    of each anchor. total (2, A): sum of both counts. floor: added to both densities.
    logs (G + 1, B): logarithms of the parts' densities, used at anchor -1, where the point occludes another part.
    face (h, w), label (T,): the rendered body, see `count`.
    joined (G + 1, G + 1) bool: parts that may lie next to each other, the last index is the outside. A line ends where
    it reaches a part that is not joined with own (N,) inside or beyond (N,) outside: samples behind are 0.
    guard [px]: about the contour, where lines do not end.
    """
    height, width = image.shape[:2]
    for p in range(contour.shape[1]):
        u, v, a, b = contour[0, p], contour[1, p], contour[2, p], contour[3, p]
        a_ = anchor[p]
        for side in range(2):
            ended, stays = False, beyond[p] if side else own[p]
            for q in range(half):
                k = half + q if side else half - 1 - q
                ratio = 0.0
                if not ended:
                    for r in range(step):
                        s = (k - half) * step + r + 0.5
                        x, y = u + s * a, v + s * b
                        i, j = math.floor(x + 0.5), math.floor(y + 0.5)
                        if not (0 <= i < width and 0 <= j < height):
                            ended = True
                            break
                        if abs(s) > guard:
                            here = part(face, label, x, y, left, top, scale)
                            if here < -1 or not joined[stays, here]:
                                ended = True
                                break
                        c = bins[_colour(image, j, i)]
                        if a_ >= 0:
                            t = table[a_, c]
                            if t == UNKNOWN:
                                t = _found(table, counts, total, general, inner, floor, most, a_, c)
                            ratio += t
                        else:
                            t = logs[own[p], c] - logs[beyond[p], c]
                            ratio += most if t > most else -most if t < -most else t
                out[p, k] = ratio


@jit
def places(lines, step, heat, out):
    """Estimate the contour's position on each line (N, 2 half) of log ratios: out (3, N).

    The likelihood of a contour at boundary c is exp(S(c)), with S(c) the sum of the log ratios inside of c. It is
    raised to the power 1 / heat, because neighbouring pixels are correlated. out: mean [px] and variance [px²] of the
    contour's offset, and the log likelihood ratio of the best position to no contour on the line.
    """
    n = lines.shape[1]
    half = n // 2
    total = np.empty(n + 1)
    for p in range(lines.shape[0]):
        total[0], best = 0.0, 0.0
        for k in range(n):
            total[k + 1] = total[k] + lines[p, k]
            best = total[k + 1] if total[k + 1] > best else best
        weight, mean, square = 0.0, 0.0, 0.0
        for k in range(n + 1):
            x = (k - half) * step
            if total[k] > best - 20.0 * heat:
                w = math.exp((total[k] - best) / heat)
                weight += w
                mean += w * x
                square += w * x * x
        mean /= weight
        out[0, p] = mean
        out[1, p] = square / weight - mean * mean + step * step / 12.0
        out[2, p] = best - (total[n] if total[n] > 0.0 else 0.0)


@jit
def shifts(lines, step, out):
    """Shift each contour point by the rule of P3 2.4.2 on the same lines: out (2, N), offset [px] and variance [px²].

    The offset is one step outwards where the two samples next to the contour together look like the body, one step
    inwards where they do not, 0 where their log ratio is 0. The variance is step².
    """
    half = lines.shape[1] // 2
    for p in range(lines.shape[0]):
        here = lines[p, half - 1] + lines[p, half]
        out[0, p] = step if here > 0.0 else -step if here < 0.0 else 0.0
        out[1, p] = step * step


@jit
def ratio_map(image, bins, ratio, left, top, step, out):
    """Mean log ratio in cells of step x step pixels, starting at pixel (left, top): out (h, w); 0 outside the image."""
    height, width = image.shape[:2]
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            total = 0.0
            for y in range(top + j * step, top + (j + 1) * step):
                if 0 <= y < height:
                    for x in range(left + i * step, left + (i + 1) * step):
                        if 0 <= x < width:
                            total += ratio[bins[_colour(image, y, x)]]
            out[j, i] = total / (step * step)


@jit
def explained(vertices, faces, poses, lens, ratios, room, depth, face, out):
    """Sum a map of log ratios (h, w) inside the body's silhouette, for M poses: out (M,).

    vertices (V, 3) [m]: about the body's centre, along the camera's axes. poses (M, 4, 4): take them to the camera.
    lens: fx, fy, cx, cy, near of the map. room, depth, face: work space of `rasterise`.
    """
    for m in range(len(poses)):
        rasterise(vertices, poses[m], faces, lens[0], lens[1], lens[2], lens[3], lens[4], False, room, depth, face)
        total = 0.0
        for j in range(face.shape[0]):
            for i in range(face.shape[1]):
                if face[j, i] >= 0:
                    total += ratios[j, i]
        out[m] = total


@jit
def likelihood(image, bins, logs, face, label, left, top, scale):
    """Log likelihood ratio of an image with the rendered body to one without it: a sum over pixels.

    logs (G + 1, B): logarithms of each part's colour density and, last, of the background's. face, label, left, top,
    scale: see `count`. A rendered pixel counts as many as the image pixels that it covers.
    """
    total, height, width = 0.0, image.shape[0], image.shape[1]
    around = len(logs) - 1
    for j in range(face.shape[0]):
        y = math.floor((j + 0.5) / scale - 0.5 + top + 0.5)
        if not 0 <= y < height:
            continue
        for i in range(face.shape[1]):
            x = math.floor((i + 0.5) / scale - 0.5 + left + 0.5)
            if face[j, i] >= 0 and 0 <= x < width:
                b = bins[_colour(image, y, x)]
                total += logs[label[face[j, i]], b] - logs[around, b]
    return total / (scale * scale)
