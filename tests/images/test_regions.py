"""Colours inside and outside of a contour: bins, statistics, and the kernels against plain numpy."""

import cv2
import numpy as np
import pytest

from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import RegionColours, RegionSettings, colour_bins

RANDOM = np.random.default_rng(4)
IMAGE = RANDOM.integers(0, 256, (60, 80, 3), dtype=np.uint8)
FACE = np.full((40, 50), -1, np.int32)
FACE[10:30, 12:35] = 7
FACE[10:30, 24:35] = 8
FACE[20:26, 33:44] = -2  # something else
LABEL = np.array([0] * 8 + [1])  # part of each triangle
JOINED = np.eye(3, dtype=bool)
WINDOW = (5.0, 8.0, 0.8)  # left, top, scale


def number(image):
    r, g, b = np.moveaxis(image.astype(np.int64) >> 3, -1, 0)
    return (r << 10) | (g << 5) | b


def drawn(x, y):
    left, top, scale = WINDOW
    i, j = np.floor((x - left + 0.5) * scale).astype(int), np.floor((y - top + 0.5) * scale).astype(int)
    ok = (i >= 0) & (i < FACE.shape[1]) & (j >= 0) & (j < FACE.shape[0])
    face = np.where(ok, FACE[np.clip(j, 0, FACE.shape[0] - 1), np.clip(i, 0, FACE.shape[1] - 1)], -1)
    return np.where(face >= 0, LABEL[face], face)


@pytest.mark.parametrize("space", ["lab", "rgb"])
def test_colours_that_differ_little_share_a_bin_and_others_do_not(space):
    bins, count = colour_bins(space, 16)
    assert set(np.unique(bins)) == set(range(count)) and len(bins) == 32768
    colours = np.array([[200, 40, 40], [201, 41, 41], [40, 200, 40], [8, 8, 8], [250, 250, 250]], np.uint8)
    red, same, green, black, white = bins[number(colours)]
    assert red == same and len({red, green, black, white}) == 4


def test_bins_in_lab_follow_lab():
    """Colours of one bin lie within a bin's width of each other along every axis."""
    bins, _ = colour_bins("lab", 16)
    c = np.arange(32768)
    rgb = (np.stack([c >> 10, (c >> 5) & 31, c & 31], 1) * 8 + 4).astype(np.float32) / 255
    lab = cv2.cvtColor(rgb[None], cv2.COLOR_RGB2Lab)[0]
    for b in RANDOM.choice(bins, 20):
        assert (np.ptp(lab[bins == b], axis=0) <= np.ptp(lab, axis=0) / 16 + 1e-3).all()


def test_pixels_are_counted_where_they_lie():
    bins, count = colour_bins("rgb", 8)
    box = np.array([4, 6, 70, 55])
    told = np.zeros((4, count))
    kernels.count(IMAGE, bins, FACE, LABEL, *WINDOW, box, told[:2], *told[2:])
    expected, of = np.zeros((4, count)), bins[number(IMAGE)]
    for y in range(60):
        for x in range(80):
            near = box[0] <= x < box[2] and box[1] <= y < box[3]
            if not near and y % 6 == 0 and x % 6 == 0:
                expected[3, of[y, x]] += 1
            if near and (y - box[1]) % 3 == 0 and (x - box[0]) % 3 == 0:
                here = drawn(np.array([x, x - 2, x + 2, x, x]), np.array([y, y, y, y - 2, y + 2]))
                if (here == here[0]).all() and here[0] > -2:
                    expected[here[0] if here[0] >= 0 else 2, of[y, x]] += 1
    np.testing.assert_array_equal(told, expected)
    assert (expected.sum(axis=1) > 10).all()


def contour(count=30):
    turn = RANDOM.uniform(0, 2 * np.pi, count)
    uv = np.stack([RANDOM.uniform(15, 55, count), RANDOM.uniform(15, 45, count)])
    return np.concatenate([uv, [np.cos(turn), np.sin(turn)]])


def test_profiles_are_sums_of_log_ratios_along_the_normals():
    bins, count = colour_bins("rgb", 8)
    lines, anchor = contour(), RANDOM.integers(-1, 3, 30)
    own, beyond = RANDOM.integers(0, 2, 30), np.full(30, -1)
    beyond[anchor < 0] = 1 - own[anchor < 0]
    table, logs = RANDOM.normal(size=(3, count)).astype(np.float32), RANDOM.normal(size=(2, count)).astype(np.float32)
    half, step, guard, most = 5, 2, 3.0, 1.5
    out = np.empty((30, 2 * half))
    known = np.zeros((2, 3, 1), np.float32), np.ones((2, 3)), np.zeros((2, count)), np.zeros(3, np.int64), 0.0, most
    kernels.profiles(
        IMAGE, bins, table, *known, logs, anchor, lines, FACE, LABEL, *WINDOW, JOINED, own, beyond, half, step, guard,
        out,
    )  # fmt: skip
    between = np.clip(logs[own] - logs[beyond], -most, most)
    expected = np.zeros_like(out)
    for p in range(30):
        for side in (0, 1):
            ended = False
            for q in range(half):
                k = half + q if side else half - 1 - q
                for r in range(step):
                    s = (k - half) * step + r + 0.5
                    x, y = lines[0, p] + s * lines[2, p], lines[1, p] + s * lines[3, p]
                    i, j = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
                    outside = not (0 <= i < 80 and 0 <= j < 60)
                    other = abs(s) > guard and drawn(np.array(x), np.array(y)) != (beyond if side else own)[p]
                    ended = ended or outside or other
                    if not ended:
                        row = between[p] if anchor[p] < 0 else table[anchor[p]]
                        expected[p, k] += row[bins[number(IMAGE)[j, i]]]
    np.testing.assert_allclose(out, expected, atol=1e-5)


@pytest.mark.parametrize("heat", [1.0, 3.0])
def test_a_place_is_the_mean_of_its_likelihood(heat):
    lines, step = RANDOM.normal(0, 2, (40, 16)), 2.0
    out = np.empty((3, 40))
    kernels.places(lines, step, heat, out)
    total = np.concatenate([np.zeros((40, 1)), np.cumsum(lines, axis=1)], axis=1)
    w = np.exp((total - total.max(axis=1, keepdims=True)) / heat)
    w /= w.sum(axis=1, keepdims=True)
    x = (np.arange(17) - 8) * step
    np.testing.assert_allclose(out[0], w @ x, atol=1e-6)
    np.testing.assert_allclose(out[1], w @ x**2 - (w @ x) ** 2 + step**2 / 12, atol=1e-5)
    np.testing.assert_allclose(out[2], total.max(axis=1) - np.maximum(total[:, -1], 0.0), atol=1e-9)


def test_a_clear_edge_is_found_where_it_is():
    """The body's colours up to 3 px outside of the contour: that is where the contour belongs."""
    lines = np.where(np.arange(24) < 15, 4.0, -4.0)[None]
    out, shift = np.empty((3, 1)), np.empty((2, 1))
    kernels.places(lines, 1.0, 1.0, out)
    assert out[0, 0] == pytest.approx(3.0, abs=0.05) and out[1, 0] < 0.3
    kernels.shifts(lines, 1.0, shift)
    assert shift[0, 0] == 1.0  # the paper's rule: one step outwards
    kernels.shifts(-lines, 1.0, shift)
    assert shift[0, 0] == -1.0


def test_log_ratios_of_a_map_are_means_over_cells():
    bins, count = colour_bins("rgb", 8)
    ratio = RANDOM.normal(size=count).astype(np.float32)
    out = np.empty((12, 15))
    kernels.ratio_map(IMAGE, bins, ratio, 10, 5, 4, out)
    whole = ratio[bins[number(IMAGE)]][5:53, 10:70]
    np.testing.assert_allclose(out, whole.reshape(12, 4, 15, 4).mean(axis=(1, 3)), atol=1e-5)


def statistics(own=True):
    s = RegionSettings(space="rgb", levels=8, anchors=3 if own else 0)
    _, count = colour_bins(s.space, s.levels)
    counts = RANDOM.integers(0, 50, (3, count)).astype(float)

    def lines(weight, into):
        into += weight.astype(np.float32)[:, None, None] * counts[:2, None].astype(np.float32)

    return s, counts, lines, RegionColours.none(count, s).blended(counts[:1], counts[1:], lines, s)


def test_the_first_images_count_alike():
    s, counts, lines, colours = statistics()
    np.testing.assert_allclose(colours.inside[0], counts[0] / counts[0].sum())
    ones = 0.0 * counts + 1.0
    for _ in range(4):
        colours = colours.blended(ones[:1], ones[1:], lines, s)
    even = 1.0 / counts.shape[1]
    rate = [1 / 2, 1 / 3, 1 / 4, 1 / 5]
    left = np.prod([1 - max(r, s.rate) for r in rate])
    np.testing.assert_allclose(colours.inside[0] - even, left * (counts[0] / counts[0].sum() - even), atol=1e-12)


def test_ratios_are_found_when_they_are_asked_for():
    s, _, _, colours = statistics()
    ratios, (bins, _) = colours.ratios(s), colour_bins(s.space, s.levels)
    lines, anchor = contour(), RANDOM.integers(0, 3, 30)
    own = np.zeros(30, np.int64), np.full(30, -1)
    kernels.profiles(
        IMAGE, bins, *ratios.packed, ratios.logs, anchor, lines, FACE, LABEL, *WINDOW, JOINED, *own, 8, 1, 3.0,
        np.empty((30, 16)),
    )  # fmt: skip
    a, b = np.nonzero(ratios.table < kernels.UNKNOWN)
    assert 50 < len(a) < ratios.table.size
    np.testing.assert_allclose(ratios.table[a, b], ratios.at(a, b), atol=1e-5)
    assert np.abs(ratios.whole).max() <= s.most


def test_one_statistic_of_the_whole_body_is_an_option():
    s, _, _, colours = statistics(own=False)
    ratios = colours.ratios(s)
    np.testing.assert_array_equal(ratios.table, ratios.whole[None])


def test_a_part_that_is_hidden_keeps_its_colours_and_one_never_seen_has_the_bodys():
    s, counts, lines, _ = statistics()
    parts = RANDOM.integers(0, 50, (3, counts.shape[1])).astype(float)
    parts[2] = 0.0
    first = RegionColours.none(counts.shape[1], s, 3).blended(parts, counts[1:], lines, s)
    later = first.blended(parts * [[1.0], [0.0], [0.0]], counts[1:], lines, s)
    np.testing.assert_array_equal(later.inside[1], first.inside[1])
    assert list(later.times) == [2, 1, 0]
    ratios = later.ratios(s, np.array([0, 1, 2]))
    body = later.pixels @ later.inside / later.pixels.sum()
    np.testing.assert_allclose(ratios.general[2], s.spread * body)
    bins = np.arange(5)
    told = ratios.between(np.zeros(5, int), np.ones(5, int), bins)
    np.testing.assert_allclose(told, np.clip(ratios.logs[0, :5] - ratios.logs[1, :5], -s.most, s.most))
