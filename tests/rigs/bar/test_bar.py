"""A bar with two targets: found in images, start without poses, adjustment with its deviations; truth and bad input."""

import numpy as np
import pytest
from benchmarks.scenes.bar_scene import bar_rig, draw_bar, see_bar, wave_bar

from kinefit.errors import CalibrationError, FileError
from kinefit.geometry import se3
from kinefit.rigs.bar.bundle import BarProblem
from kinefit.rigs.bar.calibrate import calibrate_bar
from kinefit.rigs.bar.start import epipolar, flat, on_floor, place
from kinefit.rigs.bar.targets import BarViews, read_centroids, targets_in
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import CENTRE, COLUMNS, TIME, CameraPrior

LENGTH = 0.9


@pytest.fixture(scope="module")
def known():
    rig, ends = bar_rig(), wave_bar(LENGTH, 90, seed=3)
    return rig, ends, see_bar(rig, ends, seed=3)


@pytest.fixture(scope="module")
def found(known):
    return calibrate_bar(known[2], LENGTH)


def test_from_nothing_to_cameras(known, found):
    rig, ends, _ = known
    expected = rig.moved(rig.cameras[0].T_camera_world)
    assert found.sigma_px == pytest.approx(0.1, rel=0.15)
    for camera, true in zip(found.rig, expected):
        report = found.cameras[camera.name]
        assert report.rms_px < 0.11 and report.used > 0.9 * report.places
        z = (camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - true.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]) / report.std[:4]
        assert np.abs(z).max() < 4.5
        assert report.std_of("fx") < 2e-3 * true.matrix[0, 0]
        assert np.linalg.norm(camera.centre_world - true.centre_world) < 0.01
    apart = np.linalg.norm(found.x_world[:, 1] - found.x_world[:, 0], axis=1)
    assert apart == pytest.approx(LENGTH, rel=2e-3)
    middle = se3.apply(rig.cameras[0].T_camera_world, ends[found.frames].mean(axis=1))
    assert np.abs(found.x_world.mean(axis=1) - middle).max() < 0.01


def test_the_first_camera_defines_the_world_and_any_may_be_first(known, found):
    seen = dict(reversed(list(known[2].items())))
    other = calibrate_bar(seen, LENGTH)
    assert found.rig["cam0"].T_camera_world == pytest.approx(np.eye(4), abs=1e-12)
    assert found.cameras["cam0"].std[-6:] == pytest.approx(0.0)
    assert found.cameras["cam1"].std[-6:].min() > 0
    assert other.rig.distances["cam1", "cam0"] == pytest.approx(found.rig.distances["cam0", "cam1"], rel=1e-5)
    assert other.rig["cam1"].matrix == pytest.approx(found.rig["cam1"].matrix, rel=1e-5, abs=1e-3)


def test_an_unsure_length_makes_places_unsure_and_nothing_else(known, found):
    loose = calibrate_bar(known[2], LENGTH, length_sigma=0.009)
    metres = np.linalg.norm(loose.rig["cam2"].centre_world)
    a, b = (one.cameras["cam2"] for one in (loose, found))
    assert np.linalg.norm(a.std[9:12]) == pytest.approx(0.01 * metres, rel=0.05)
    assert a.std[:9] == pytest.approx(b.std[:9], rel=1e-6)


def test_lenses_that_are_given_stay(known):
    rig, _, seen = known
    out = calibrate_bar(seen, LENGTH, interiors=rig)
    for camera, true in zip(out.rig, rig):
        assert np.array_equal(camera.matrix, true.matrix) and out.cameras[camera.name].std_of("fx") == 0
    true = np.linalg.norm(rig["cam0"].centre_world - rig["cam2"].centre_world)
    assert out.rig.distances["cam0", "cam2"] == pytest.approx(true, rel=3e-4)
    with pytest.raises(CalibrationError, match="no intrinsics of camera 'cam2'"):
        calibrate_bar(seen, LENGTH, interiors=rig.select(("cam0", "cam1")))


def test_derivatives_of_the_adjustment(known):
    rig, ends, seen = known
    uv = np.stack([np.stack([seen[c.name].ends.get(f, np.full((2, 2), np.nan)) for c in rig]) for f in range(5)])
    x = ends[:5] + 1e-3
    problem, sigma = BarProblem(uv, LENGTH, 1e3, 10.0), np.full((len(rig), COLUMNS), 2.0)  # far from the losses' bends
    sigma[:, TIME], prior = 0.0, CameraPrior(rig, sigma)
    rng, zero = np.random.default_rng(0), np.zeros(len(rig))
    start = BundleState(*prior.moved(rig, zero, 1e-3 * rng.normal(size=prior.free.sum())), x)
    arrow = adjust(start, prior, problem, iterations=0).posterior
    size = np.full((len(rig), COLUMNS), 1e-5)
    size[:, CENTRE] = 1e-2
    for _ in range(4):
        step, move = rng.normal(size=prior.free.sum()) * size[prior.free], 1e-5 * rng.normal(size=x.shape)

        def cost(sign, step=step, move=move):
            there, _ = prior.moved(start.rig, zero, sign * step)
            return adjust(BundleState(there, zero, x + sign * move), prior, problem, iterations=0).cost

        numeric = (cost(1.0) - cost(-1.0)) / 2
        told = -2 * (arrow.g @ step + np.sum(arrow.blocks[0].g * move.reshape(-1, 6)))
        assert told == pytest.approx(numeric, rel=1e-4)


def test_orders_are_found_by_the_epipolar_lines_and_by_the_length(known):
    rig, ends, _ = known
    uv = np.stack([camera.project(ends) for camera in rig], axis=1)
    swapped = np.random.default_rng(1).random(uv.shape[:2]) < 0.5
    mixed = np.where(swapped[:, :, None, None], uv[:, :, ::-1], uv)
    a, b = (flat(rig.cameras[c], mixed[:, c], True) for c in (0, 1))
    _, exchanged, inside = epipolar(a, b, 1e-4)
    agree = (exchanged == (swapped[:, 0] ^ swapped[:, 1]))[inside]
    assert inside.mean() > 0.95 and agree.mean() > 0.95
    placed = place(rig, mixed, LENGTH, 1.0, 0.01)
    assert not placed.ambiguous.any()
    first = np.linalg.norm(placed.x_world - ends, axis=2).max(axis=1)
    turned = np.linalg.norm(placed.x_world[:, ::-1] - ends, axis=2).max(axis=1)
    assert np.minimum(first, turned).max() < 1e-6


def test_a_bar_that_may_be_either_way_is_left_out():
    rig = bar_rig(2)
    middle = np.array([0.0, 0.0, 1.0])
    base = rig.cameras[1].centre_world - rig.cameras[0].centre_world
    normal = np.cross(base, middle - rig.cameras[0].centre_world)
    side = np.cross(normal, middle - rig.cameras[0].centre_world)  # in the plane of both centres and the middle
    side *= 0.5 * LENGTH / np.linalg.norm(side)
    alike = np.array([middle - side, middle + side])
    for turn in np.linspace(0, np.pi, 181):  # somewhere in that plane both orders keep the length
        R = se3.exp_so3(turn * normal / np.linalg.norm(normal))
        ends = (alike - middle) @ R.T + middle
        uv = np.stack([camera.project(ends) for camera in rig])[None]
        if place(rig, uv, LENGTH, 1.0, 0.05).ambiguous[0]:
            break
    else:
        raise AssertionError("no bar was ambiguous")


def test_floor(known):
    rig, ends, _ = known
    ends = ends.copy()
    ends[5], ends[9] = [[0.0, 0, 0], [LENGTH, 0, 0]], [[0.1, 0.5, 0], [0.1, 0.5 - LENGTH, 0]]
    seen = see_bar(rig, ends, seed=4)
    out = calibrate_bar(seen, LENGTH, floor=(5, 9))
    heights = np.array([camera.centre_world[2] for camera in out.rig])
    assert heights == pytest.approx([camera.centre_world[2] for camera in rig], abs=0.01)
    for floor, said in (((5,), "along one line"), ((5, 4000), "frame 4000")):
        with pytest.raises(CalibrationError, match=said):
            on_floor(out.rig, out.x_world, out.frames, floor)


def changed(seen, change):
    return {name: BarViews(v.size, change(name, v.ends), v.looked) for name, v in seen.items()}


def test_what_it_refuses(known):
    rig, ends, seen = known
    rng = np.random.default_rng(0)
    level = ends.copy()
    level[..., 2] = 0.5
    cases = [
        ("common places", see_bar(rig, ends[:8])),
        ("one plane", see_bar(rig, level)),
        ("agree in", changed(seen, lambda n, e: {f: rng.uniform(0, 1000, (2, 2)) for f in e})),
        ("camera cam2", changed(seen, lambda n, e: {f + 31 * (n == "cam2"): uv for f, uv in e.items()})),
        ("1 camera", {"cam0": seen["cam0"]}),
    ]
    for said, views in cases:
        with pytest.raises(CalibrationError, match=said):
            calibrate_bar(views, LENGTH)
    with pytest.raises(CalibrationError, match="bar of 900 m"):
        calibrate_bar(seen, 900.0)


def test_a_wrong_length_is_told_where_a_second_one_is_known(known):
    rig, _, seen = known
    true = float(np.linalg.norm(rig["cam0"].centre_world - rig["cam1"].centre_world))
    with pytest.raises(CalibrationError, match=r"a bar of 0\.(90|89)\d* m would agree|a bar of 0\.9 m would"):
        calibrate_bar(seen, 1.05 * LENGTH, known_distance=("cam0", "cam1", true))


def test_confused_targets_are_left_out(known, found):
    rng = np.random.default_rng(0)

    def confuse(name, ends):
        return {f: np.stack([uv[0], rng.uniform(0, 1000, 2)]) if rng.random() < 0.1 else uv for f, uv in ends.items()}

    out = calibrate_bar(changed(known[2], confuse), LENGTH)
    assert out.sigma_px == pytest.approx(0.1, rel=0.2)
    assert out.rig.distances["cam0", "cam1"] == pytest.approx(found.rig.distances["cam0", "cam1"], rel=1e-3)


def test_centroids_to_a_tenth_of_a_pixel_without_the_lamps():
    camera = bar_rig(1, (640, 480)).cameras[0]
    lamp, errors = np.array([[0.5, -0.4, 1.2]]), []
    still = draw_bar(camera, np.full((2, 3), 1e3), lamps=lamp, seed=99).astype(np.float32)
    for k, ends in enumerate(wave_bar(0.5, 12, low=(-0.4, -0.4, 0.6), high=(0.4, 0.4, 1.4), seed=2)):
        image = draw_bar(camera, ends, lamps=lamp, seed=k)
        assert len(targets_in(image)) == 3 and len(targets_in(np.zeros_like(image))) == 0
        uv, true = targets_in(image, still), camera.project(ends)
        if len(uv) == 2:
            errors.append(min(np.abs(uv - true).max(), np.abs(uv[::-1] - true).max()))
    assert len(errors) >= 11 and np.median(errors) < 0.1


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (4, 2), (2, 3)])
def test_small_targets_are_found_where_they_are(shape):
    image = np.full((100, 200), 20, np.uint8)
    image[40 : 40 + shape[0], 60 : 60 + shape[1]] = 230
    image[70:74, 150:153] = 240
    centres = np.array([[60 + (shape[1] - 1) / 2, 40 + (shape[0] - 1) / 2], [151.0, 71.5]])
    uv = targets_in(image)
    np.testing.assert_allclose(uv[np.argsort(uv[:, 0])], centres, atol=0.05)


def test_tables(tmp_path, known):
    file = tmp_path / "centroids.csv"
    rows = [f"{n},{f},{u},{v}" for n, s in known[2].items() for f, uv in s.ends.items() for u, v in uv]
    file.write_text("camera,frame,u,v\n" + "\n".join(rows) + "\ncam0,5000,3,4\n")
    seen = read_centroids(file, (1920, 1080))
    assert list(seen["cam1"].ends) == list(known[2]["cam1"].ends) and 5000 not in seen["cam0"].ends
    assert np.allclose(seen["cam1"].ends[7], known[2]["cam1"].ends[7])
    for text, sizes, error, said in (
        ("camera,frame,u\n", (9, 9), FileError, "no column v"),
        ("camera,frame,u,v\na,1,x,2\n", (9, 9), FileError, "line 2"),
        ("camera,frame,u,v\na,1,50,2\na,1,3,2\n", (9, 9), CalibrationError, "9x9"),
        ("camera,frame,u,v\na,1,5,2\n", (9, 9), CalibrationError, "two targets"),
        ("camera,frame,u,v\na,1,5,2\n", {"b": (9, 9)}, CalibrationError, "no image size"),
        ("camera,frame,u,v\n", (9, 9), FileError, "no targets"),
    ):
        file.write_text(text)
        with pytest.raises(error, match=said):
            read_centroids(file, sizes)
