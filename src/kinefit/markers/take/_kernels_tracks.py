"""Link points of consecutive frames into trajectories by constant-velocity prediction."""

import math

import numpy as np

from kinefit._jit import jit


@jit
def link_points(points, starts, column, start, still, steady, piece):
    """Link points into pieces of trajectories, numbered in the order of their first frames.

    Parameters
    ----------
    points : (T, 3) [m] all measured points, frame by frame
    starts : (F + 1,) int, the first point of each frame
    column : (T,) int, the file's column of each
    start, still, steady : [m] largest prediction error in the second frame of a piece, without and with moving
        neighbours, and in later frames
    piece : (T,) int, written: piece of each point

    Returns
    -------
    number of pieces
    """
    count = 0
    max_points = 0
    for f in range(len(starts) - 1):
        n_here = starts[f + 1] - starts[f]
        max_points = n_here if n_here > max_points else max_points
    error = np.empty((max_points, max_points))
    velocity = np.zeros((len(points), 3))
    length = np.zeros(len(points), np.int64)
    tolerance = np.empty(len(points))
    before = np.empty(max_points, np.int64)
    after = np.empty(max_points, np.int64)
    for f in range(len(starts) - 1):
        a, b = starts[f], starts[f + 1]
        n = b - a
        p = starts[f - 1] if f > 0 else a
        m = a - p
        for j in range(n):
            before[j] = -1
        for i in range(m):
            after[i] = -1
            x = points[p + i, 0] + velocity[p + i, 0]
            y = points[p + i, 1] + velocity[p + i, 1]
            z = points[p + i, 2] + velocity[p + i, 2]
            for j in range(n):
                dx, dy, dz = points[a + j, 0] - x, points[a + j, 1] - y, points[a + j, 2] - z
                error[i, j] = math.sqrt(dx * dx + dy * dy + dz * dz)
        for i in range(m):  # same column of the file, unless another point predicts it much better
            for j in range(n):
                if column[a + j] == column[p + i] and error[i, j] <= tolerance[p + i]:
                    is_best = True
                    for k in range(n):
                        if k != j and error[i, k] < 0.3 * error[i, j] - 0.002:
                            is_best = False
                    for k in range(m):
                        if k != i and error[k, j] < 0.3 * error[i, j] - 0.002:
                            is_best = False
                    if is_best:
                        after[i] = j
                        before[j] = i
        for i in range(m):  # mutual nearest neighbours without a competitor
            if after[i] >= 0:
                continue
            best, second = -1, math.inf
            low = math.inf
            for j in range(n):
                if error[i, j] < low:
                    second = low
                    low, best = error[i, j], j
                elif error[i, j] < second:
                    second = error[i, j]
            if best < 0 or before[best] >= 0 or low > tolerance[p + i]:
                continue
            other = math.inf
            for k in range(m):
                if k != i and error[k, best] < other:
                    other = error[k, best]
            if 2.0 * low + 0.003 < second and 2.0 * low + 0.003 < other:
                after[i] = best
                before[best] = i
        for j in range(n):
            i = before[j]
            if i < 0:
                piece[a + j] = count
                count += 1
                length[a + j] = 1
            else:
                piece[a + j] = piece[p + i]
                length[a + j] = length[p + i] + 1
                for c in range(3):
                    velocity[a + j, c] = points[a + j, c] - points[p + i, c]
        for j in range(n):  # a new piece takes the mean velocity of its neighbours
            tolerance[a + j] = steady
            if length[a + j] > 1:
                continue
            weight = 0.0
            for k in range(n):
                if length[a + k] > 1:
                    dx = points[a + j, 0] - points[a + k, 0]
                    dy = points[a + j, 1] - points[a + k, 1]
                    dz = points[a + j, 2] - points[a + k, 2]
                    w = 1.0 / (dx * dx + dy * dy + dz * dz + 1e-4) ** 2
                    weight += w
                    for c in range(3):
                        velocity[a + j, c] += w * velocity[a + k, c]
            tolerance[a + j] = still if weight > 0 else start
            if weight > 0:
                for c in range(3):
                    velocity[a + j, c] /= weight
    return count
