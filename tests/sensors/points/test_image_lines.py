"""Image lines as a sensor: a crate of known size is found by its edges, lenses bend them, hidden ones say nothing."""

from itertools import product

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body, parse_body
from kinefit.errors import BodyError, CalibrationError, ObservationError
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.losses import SQUARED, geman_mcclure
from kinefit.observations import LineFrame
from kinefit.sensors.points.image_lines import ImageLineSensor, image_lines
from kinefit.sensors.scene import Scene
from kinefit.solving.equations import normal_equations
from kinefit.solving.least_squares import gauss_newton
from kinefit.solving.rows import DofRows

CORNERS = dict(zip("abcdefgh", product((0.0, 0.6), (0.0, 0.4), (0.0, 0.3))))
EDGES = {m + n: (m, n) for m in CORNERS for n in CORNERS if m < n and np.sum(np.array(CORNERS[m]) != CORNERS[n]) == 1}
CRATE = parse_body(
    '[body]\nname = "crate"\n[[segment]]\nname = "crate"\njoint = { name = "world", type = "free" }\n[landmarks]\n'
    + "".join(f'{name} = {{ segment = "crate", at = {list(at)} }}\n' for name, at in CORNERS.items())
)
TRUTH = BodyState(np.eye(4), np.zeros(0)).retract(np.array([0.1, -0.2, 2.5, 0.4, 0.5, -0.3]))
MATRIX = [[700.0, 0.0, 319.5], [0.0, 700.0, 239.5], [0.0, 0.0, 1.0]]
LENSES = {
    "none": ("radtan", ()), "bent": ("radtan", (-0.25, 0.08, 0.001, -0.002)),
    "fisheye": ("fisheye", (0.05, -0.02, 0.0, 0.0)),
}  # fmt: skip


def rig(lens="none"):
    model, k = LENSES[lens]
    return Rig((Camera("cam", (640, 480), MATRIX, k, model),))


def seen(state=TRUTH, lens="none", edges=EDGES, share=(0.1, 0.8), noise=0.0):
    """The edges' image lines, each by two points of the edge that are not its ends."""
    x = dict(zip(CRATE.landmarks.names, CRATE.positions(state, CRATE.landmarks)))
    at = np.array([[(1 - s) * x[m] + s * x[n] for s in share] for m, n in edges.values()])
    ends = rig(lens).cameras[0].project(at) + np.random.default_rng(0).normal(scale=noise, size=(len(edges), 2, 2))
    return LineFrame("cam", 0.0, tuple(edges), tuple(edges.values()), ends)


def matched(frame, scene, loss=SQUARED, reach=0.03):
    return ImageLineSensor("lines cam", 1.5, loss, 0.03).prepare(frame, scene).match(scene, reach)


def test_the_crate_has_twelve_edges():
    assert len(EDGES) == 12


@pytest.mark.parametrize("lens", LENSES)
def test_a_crate_is_found_by_its_edges(lens):
    state = TRUTH.retract(np.array([0.08, -0.05, 0.2, 0.15, -0.2, 0.1]))
    scene = Scene(CRATE, state, rig(lens))
    match = matched(seen(lens=lens), scene)
    for _ in range(20):
        state = gauss_newton(CRATE, state, match.rows(scene)).state
        scene = scene.at(state)
    np.testing.assert_allclose(state.T_world_root, TRUTH.T_world_root, atol=1e-8)


@pytest.mark.parametrize(("lens", "close"), [("none", 1e-6), ("bent", 0.02), ("fisheye", 0.02)])
def test_rows_are_the_derivative_of_the_distance_in_pixels(lens, close):
    state = TRUTH.retract(np.array([0.01, -0.01, 0.02, 0.01, -0.02, 0.01]))
    scene = Scene(CRATE, state, rig(lens))
    match, step = matched(seen(lens=lens), scene), 1e-6

    def off(delta):
        (rows,) = match.rows(scene.at(state.retract(delta)))
        return np.sqrt(rows.weight) * rows.residual  # signed, in standard deviations

    (rows,) = match.rows(scene)
    arm = rows.point - state.T_world_root[:3, 3]
    turned = np.cross(arm, rows.direction)
    analytic = -np.sqrt(rows.weight)[:, None] * np.concatenate([rows.direction, turned], axis=1)
    numeric = np.stack([(off(step * e) - off(-step * e)) / (2 * step) for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(numeric, analytic, atol=close * np.abs(analytic).max())
    assert len(rows) == 24 and list(rows.group) == [k for k in range(12) for _ in range(2)]


def test_a_line_of_one_point_and_lines_that_are_not_seen():
    edges = {"rail": ("a",), "hidden": ("b", "d"), "edge": ("c", "d")}
    ends = np.array([[[10.0, 20.0], [200.0, 20.0]], [[np.nan] * 2] * 2, [[5.0, 5.0], [5.0, 300.0]]])
    scene = Scene(CRATE, TRUTH, rig())
    (rows,) = matched(LineFrame("cam", 0.0, tuple(edges), tuple(edges.values()), ends), scene).rows(scene)
    assert list(rows.group) == [0, 2, 2]
    uv = rig().cameras[0].project(scene.position("a"))
    assert np.sqrt(rows.weight[0]) * abs(rows.residual[0]) == pytest.approx(abs(uv[1] - 20.0) / 1.5)


def test_tangents_of_a_bent_edge_go_through_its_image():
    camera, frame = rig("bent").cameras[0], seen(lens="bent")
    x = np.array([CRATE.positions(TRUTH, CRATE.landmarks.select((own[0],)))[0] for own in frame.landmarks])
    lines, uv = image_lines(camera, frame.ends, x), camera.project(x)
    off = np.abs(np.sum(lines[:, :2] * uv, axis=1) + lines[:, 2]) / np.hypot(*lines[:, :2].T)
    assert off.max() < 1e-6
    chord = image_lines(rig().cameras[0], frame.ends, x)  # as if the lens bent nothing
    assert np.max(np.abs(np.sum(chord[:, :2] * uv, axis=1) + chord[:, 2]) / np.hypot(*chord[:, :2].T)) > 0.1


def test_a_wrong_line_does_not_pull_and_speaks_against_the_crate():
    frame = seen(noise=0.5)
    ends = np.array(frame.ends)
    ends[3] += 120.0
    wrong = LineFrame("cam", 0.0, frame.names, frame.landmarks, ends)
    found = []
    for given in (frame, wrong):
        scene = Scene(CRATE, TRUTH, rig())
        match = matched(given, scene, geman_mcclure(3.0))
        for _ in range(10):
            scene = scene.at(gauss_newton(CRATE, scene.state, match.rows(scene)).state)
        found.append(scene.state.T_world_root[:3, 3])
        evidence = match.evidence(scene)
    assert np.linalg.norm(found[0] - found[1]) < 0.005
    assert 0 < evidence.contrary[0] < 0.2 * evidence.agreeing[0]
    scene = Scene(CRATE, TRUTH, rig())
    far, near = (matched(wrong, scene, geman_mcclure(3.0), reach) for reach in (0.3, 0.03))
    costs = [normal_equations(CRATE, TRUTH, match.rows(scene)).cost for match in (far, near)]
    assert costs[0] > costs[1]  # a wider correspondence distance lets a wrong line count for more


def test_what_the_fit_leaves_over_is_the_way_to_the_line():
    scene, frame = Scene(CRATE, TRUTH, rig()), seen()
    ends = np.array(frame.ends)
    across = np.array([[0.0, -1.0], [1.0, 0.0]]) @ (ends[0, 1] - ends[0, 0])
    ends[0] += 6.0 * across / np.linalg.norm(across)
    moved = LineFrame("cam", 0.0, frame.names, frame.landmarks, ends)
    match = matched(moved, scene, geman_mcclure(3.0))
    (left,) = match.leftovers(scene)
    assert (left.label, left.unit, left.names[:2]) == ("lines cam", "px", ("ab: a", "ab: b")) and len(left.names) == 24
    np.testing.assert_allclose(np.linalg.norm(left.values, axis=1), [6.0] * 2 + [0.0] * 22, atol=1e-6)
    np.testing.assert_allclose(left.values[0], 6.0 * across / np.linalg.norm(across), atol=1e-6)
    np.testing.assert_allclose(match.squares(scene), [2 * (6.0 / 1.5) ** 2] + [0.0] * 11, atol=1e-8)
    (rows,) = match.rows(scene)
    np.testing.assert_allclose(np.bincount(rows.group, rows.weight * rows.residual**2), match.squares(scene), atol=1e-8)
    assert left.weights[0] < 0.2 and left.weights[2:].min() > 0.99


def test_the_tracker_follows_a_crate_by_its_edges():
    tracker = Tracker(CRATE, rig(), rate=30.0, sigma={"lines cam": 1.0}, up="y")
    tracker.start_at(TRUTH)
    state = TRUTH
    for k in range(15):
        state = state.retract(np.array([0.004, 0.002, 0.005, 0.0, 0.01, 0.005]))
        frame = seen(state, noise=0.3)
        result = tracker.update([LineFrame("cam", k / 30.0, frame.names, frame.landmarks, frame.ends)], k / 30.0)
    np.testing.assert_allclose(result.state.T_world_root, state.T_world_root, atol=0.01)


def test_what_cannot_be_is_told():
    scene = Scene(CRATE, TRUTH, rig())
    ends = np.array([[[0.0, 0.0], [9.0, 9.0]]])
    with pytest.raises(BodyError, match="no point 'z'"):
        matched(LineFrame("cam", 0.0, ("l",), (("z",),), ends), scene)
    with pytest.raises(CalibrationError, match="cam2"):
        matched(LineFrame("cam2", 0.0, ("l",), (("a",),), ends), scene)
    for names, landmarks, points, said in (
        (("l", "m"), (("a",),), ends, "have shape"), (("l",), ((),), ends, "the landmarks none"),
        (("l",), (("a", "b", "c"),), ends, "a, b, c"), (("l",), (("a",),), 0 * ends, "less than a pixel"),
    ):
        with pytest.raises(ObservationError, match=said):
            LineFrame("cam", 0.0, names, landmarks, points)


def test_on_a_body_whose_joints_move():
    """A shoulder that follows the arm: derivatives of the morphed body, and what lines say of segments."""
    body = load_body("humanoid_morphing")
    angles = np.array(body.tree.usual)
    angles[body.tree.coordinates.index("arm_add_r")] += 0.8
    state = BodyState(np.eye(4), angles).retract(np.append([0.0, 0.0, 3.0], np.zeros(body.tree.n_dofs - 3)))
    scene = Scene(body, state, rig())
    own = ("r_humeral_lateral_epicondyle", "r_radial_styloid")
    uv = rig().cameras[0].project(np.array([scene.position(n) for n in own]))
    frame = LineFrame("cam", 0.0, ("forearm",), (own,), uv[None] + np.array([0.0, 1.0]))
    match = matched(frame, scene)
    (rows,) = match.rows(scene)
    assert isinstance(rows, DofRows) and list(rows.group) == [0, 0]
    step = 1e-6

    def off(delta):
        (rows,) = match.rows(scene.at(state.retract(delta)))
        return np.sqrt(rows.weight) * rows.residual

    n = body.tree.n_dofs
    numeric = np.stack([(off(step * e) - off(-step * e)) / (2 * step) for e in np.eye(n)], axis=1)
    analytic = -np.sqrt(rows.weight)[:, None] * rows.jacobian
    np.testing.assert_allclose(numeric, analytic, atol=1e-4 * np.abs(analytic).max())
    evidence, arm = match.evidence(scene), body.landmarks.segments[[body.landmarks.index(n) for n in own]]
    assert np.all(evidence.agreeing[arm] > 0) and not evidence.contrary.any()
