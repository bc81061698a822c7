"""Meshes with known distances, and a slow search over all triangles of any mesh."""

import numpy as np


def box(size):
    """Box about the origin."""
    v = (np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) - 0.5) * size
    sides = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
    return v, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def ball(radius, at=(0.0, 0.0, 0.0), around=40):
    """Ball of rings and two poles."""
    rings = around // 2
    polar = np.pi * np.arange(1, rings) / rings
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack(
        [np.outer(np.sin(polar), np.cos(angle)), np.outer(np.sin(polar), np.sin(angle)),
         np.repeat(np.cos(polar)[:, None], around, 1)], -1,
    )
    v = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1.0], [0, 0, -1.0]]])
    j, faces = np.arange(around), []
    k, north, south = (j + 1) % around, len(v) - 2, len(v) - 1
    for i in range(rings - 2):
        a, b = i * around, (i + 1) * around
        faces += [np.stack([a + j, b + j, b + k], 1), np.stack([a + j, b + k, a + k], 1)]
    last = (rings - 2) * around
    faces += [np.stack([j, k, 0 * j + north], 1), np.stack([last + k, last + j, 0 * j + south], 1)]
    return radius * v + at, np.concatenate(faces)


def points_on(vertices, faces, count, rng):
    """Points spread evenly over a mesh, and the normals of their faces."""
    c = vertices[faces]
    cross = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    area = np.linalg.norm(cross, axis=1)
    k = rng.choice(len(faces), count, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), count)
    return np.einsum("nk,nki->ni", weights, c[k]), cross[k] / area[k, None]


def winding(x, vertices, faces):
    """(N,) how often a mesh goes round each point (van Oosterom & Strackee 1983): 0 outside, 1 inside."""
    a, b, c = (vertices[faces[:, k]] - x[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    down = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(np.einsum("pti,pti->pt", a, np.cross(b, c)), down).sum(1) / (2 * np.pi)


def brute_force(x, vertices, faces):
    """Signed distances (N,) and closest points (N, 3) over all triangles, by planes and edges."""
    corners = [vertices[faces[:, k]] for k in range(3)]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    height = np.einsum("pti,ti->pt", x[:, None] - corners[0], normal)
    foot = x[:, None] - height[..., None] * normal
    within, found = np.ones(height.shape, bool), []
    for k in range(3):
        a, side = corners[k], corners[(k + 1) % 3] - corners[k]
        within &= np.einsum("pti,ti->pt", foot - a, np.cross(normal, side)) >= 0
        t = np.einsum("pti,ti->pt", x[:, None] - a, side) / np.maximum((side**2).sum(1), 1e-30)
        found.append(a + np.clip(t, 0, 1)[..., None] * side)
    found.append(np.where(within[..., None], foot, np.inf))
    candidates = np.stack(found, 2).reshape(len(x), -1, 3)
    distance = np.linalg.norm(candidates - x[:, None], axis=2)
    best = distance.argmin(1)
    rows = np.arange(len(x))
    return distance[rows, best] * np.where(winding(x, vertices, faces) > 0.5, -1, 1), candidates[rows, best]
