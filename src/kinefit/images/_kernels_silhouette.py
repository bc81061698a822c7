"""Compiled contours: level crossings of an image, with sub-pixel positions."""

from __future__ import annotations

import math

from kinefit._jit import jit


@jit
def crossings(image, level, out):
    """Write the level crossings between neighbouring pixels of an image (H, W) to out (4, N); returns their number.

    Rows of out: position u, v [px] and unit normal a, b. The normal is the negative gradient at the crossing.
    """
    height, width = image.shape
    n, room = 0, out.shape[1]
    for j in range(height):
        for i in range(width):
            here = float(image[j, i]) - level
            for way in range(2):
                k, m = (i + 1, j) if way == 0 else (i, j + 1)
                if k >= width or m >= height:
                    continue
                there = float(image[m, k]) - level
                if (here > 0.0) == (there > 0.0) or n >= room:
                    continue
                t = here / (here - there)
                left, right = (i - 1 if i > 0 else 0), (k + 1 if k + 1 < width else k)
                top, low = (j - 1 if j > 0 else 0), (m + 1 if m + 1 < height else m)
                if way == 0:
                    a = float(image[j, k]) - float(image[j, i])
                    b = float(image[low, i]) + float(image[low, k]) - float(image[top, i]) - float(image[top, k])
                    b *= 0.25
                else:
                    b = float(image[m, i]) - float(image[j, i])
                    a = float(image[j, right]) + float(image[m, right]) - float(image[j, left]) - float(image[m, left])
                    a *= 0.25
                size = math.sqrt(a * a + b * b)
                out[0, n], out[1, n] = (i + t, float(j)) if way == 0 else (float(i), j + t)
                out[2, n], out[3, n] = -a / size, -b / size
                n += 1
    return n
