"""Reading of the landmark network's numbers."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.images.detectors.roi import MIRROR, SIZE, PersonLandmarks, PoseModel, mean_with_mirrored, refine


def heat(*peaks):
    """(64, 64, K) logits with a peak at (u, v) each; None: flat."""
    v, u = np.mgrid[:64, :64]
    maps = [np.full((64, 64), -9.0) if p is None else 6 - 3 * ((u - p[0]) ** 2 + (v - p[1]) ** 2) for p in peaks]
    return np.stack(maps, axis=2)


def test_a_point_goes_to_the_middle_of_its_peak():
    points = np.array([[101.0, 62.0]])
    assert np.allclose(refine(points, heat((26, 15))), [[104, 60]], atol=0.01)
    assert np.allclose(refine(points, heat((25.5, 15))), [[102, 60]], atol=0.3)


def test_a_point_stays_where_the_map_is_flat_or_ends_or_its_peak_is_far():
    points = np.array([[101.0, 62.0], [-3.0, 40.0], [250.0, 300.0], [101.0, 62.0]])
    assert np.allclose(refine(points, heat(None, (0, 10), (62, 63), (50, 50))), points)


def plain_refine(point, logits):
    """One point, by loops, as the method is written down."""
    column, row = (int(np.floor(c / 4)) for c in point)
    if not (0 <= column < 64 and 0 <= row < 64):
        return point
    total, moment, highest = 0.0, np.zeros(2), 0.0
    for v in range(max(row - 3, 0), min(row + 4, 64)):
        for u in range(max(column - 3, 0), min(column + 4, 64)):
            weight = 1 / (1 + np.exp(-logits[v, u]))
            total, highest = total + weight, max(highest, weight)
            moment += weight * np.array([u, v])
    return moment / total * 4 if highest >= 0.5 else point


def test_all_points_at_once_are_what_one_after_the_other_is():
    rng = np.random.default_rng(0)
    points, logits = rng.uniform(-20, 276, (200, 2)), rng.normal(-5, 2, (64, 64, 200))
    points[:8] = [[0, 0], [255, 255], [3, 130], [130, 3], [256, 10], [-0.1, 9], [128, 128], [254, 1]]
    plain = [plain_refine(point, logits[:, :, k]) for k, point in enumerate(points)]
    refined = refine(points, logits)
    assert np.allclose(refined, plain)
    assert 20 < np.any(refined != points, axis=1).sum() < 180, "both cases are there"


class Interpreter:
    def __init__(self):
        landmarks = np.zeros((39, 5), np.float32)
        landmarks[:, :2] = np.arange(78).reshape(39, 2)
        landmarks[:, 3:] = [2.0, -2000.0]
        mask = np.full((1, 256, 256, 1), -1000.0, np.float32)
        mask[0, 10:20, 30:50] = 1000
        flat = np.full((1, 64, 64, 39), -9.0, np.float32)
        self.tensors = {1: landmarks.reshape(1, 195), 2: np.array([[0.75]]), 3: mask, 4: flat, 5: np.zeros((1, 117))}

    def get_input_details(self):
        return [{"index": 0, "shape": np.array([1, 256, 256, 3])}]

    def get_output_details(self):
        return [{"shape": list(t.shape), "index": k} for k, t in self.tensors.items()]

    def set_tensor(self, index, value):
        self.given = value

    def invoke(self):
        pass

    def get_tensor(self, index):
        return self.tensors[index]


def test_outputs_are_told_apart_by_their_shape_and_probabilities_do_not_overflow():
    interpreter = Interpreter()
    pose = PoseModel(interpreter)(np.full((256, 256, 3), 255, np.uint8))
    assert interpreter.given.shape == (1, 256, 256, 3) and interpreter.given.max() == 1
    assert np.allclose(pose.points, np.arange(66).reshape(33, 2))
    assert np.allclose(pose.middle, [66, 67]) and np.allclose(pose.rim, [68, 69])
    assert pose.score == 0.75
    assert np.allclose(pose.visibility, 1 / (1 + np.exp(-2))) and np.all(pose.presence == 0)
    assert pose.mask.sum() == pytest.approx(10 * 20) and pose.mask[15, 40] == 1


def mirror_image(seen):
    """What a network without errors sees in the mirror image."""

    def flip(points):
        return np.column_stack([SIZE - 1 - points[:, 0], points[:, 1]])

    middle, rim = flip(np.stack([seen.middle, seen.rim]))
    return PersonLandmarks(
        flip(seen.points)[MIRROR], seen.visibility[MIRROR], seen.presence[MIRROR], middle, rim, seen.score,
        seen.mask[:, ::-1], (seen.lifted * [-1, 1, 1])[MIRROR],
    )  # fmt: skip


@pytest.fixture
def seen():
    rng = np.random.default_rng(4)
    points, mask = rng.uniform(20, 230, (33, 2)), rng.uniform(size=(SIZE, SIZE)).astype(np.float32)
    sure = rng.uniform(0.5, 1, (2, 33))
    return PersonLandmarks(points, *sure, points[0], points[1], 0.9, mask, rng.normal(size=(33, 3)))


def test_errors_that_lean_to_one_side_cancel_in_the_mirror_image(seen):
    lean = {"points": seen.points + [3, 0], "middle": seen.middle + [3, 0], "lifted": seen.lifted + [0.1, 0, 0]}
    both = mean_with_mirrored(replace(seen, **lean), replace(
        mirror_image(seen), **{name: getattr(mirror_image(seen), name) + error for name, error in
                               (("points", [3, 0]), ("middle", [3, 0]), ("lifted", [0.1, 0, 0]))}
    ))  # fmt: skip
    for name in ("points", "visibility", "presence", "middle", "rim", "mask", "lifted"):
        assert np.allclose(getattr(both, name), getattr(seen, name), atol=1e-6), name


def test_a_mirror_image_of_nobody_or_with_sides_exchanged_does_not_count(seen):
    assert mean_with_mirrored(seen, replace(mirror_image(seen), score=0.2)) is seen
    turned = replace(mirror_image(seen), points=mirror_image(seen).points[MIRROR])
    assert mean_with_mirrored(seen, turned) is seen
