"""Boards: found in pictures, interiors, exteriors, all of it together; known truth, real recordings, bad input."""

import itertools

import cv2
import numpy as np
import pytest

from kinefit.errors import CalibrationError, FileError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.rigs.board.bundle import BoardProblem, Corners, adjust_boards
from kinefit.rigs.board.calibrate import calibrate_board
from kinefit.rigs.board.detection import Board, BoardView, CameraViews, Finder, fitting_boards, with_dictionary
from kinefit.rigs.board.extrinsics import calibrate_interiors, place_cameras
from kinefit.rigs.board.sources import camera_sources, find_boards
from kinefit.solving.bundle.adjust import BundleState
from kinefit.solving.bundle.cameras import COLUMNS, FOCAL, POSE, TIME, CameraPrior

CHECKER = Board("checkerboard", (9, 6), 0.05)
CHARUCO = Board("charuco", (5, 7), 0.06, 0.045, "5X5_100")
SIZE = (1280, 720)

# ---------------------------------------------------------------- known truth


def studio(count=3, distortion=(-0.25, 0.08, 0.001, -0.0005)):
    """Cameras on a quarter circle of 2.5 m, looking at the origin, z up."""
    cameras = []
    for i in range(count):
        azimuth = np.radians(20 + 35 * i)
        centre = np.array([2.5 * np.cos(azimuth), 2.5 * np.sin(azimuth), 1.2 + 0.2 * i])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[900.0 + 30 * i, 0, 640.0 - 8 * i], [0, 905.0 + 30 * i, 355.0 + 6 * i], [0, 0, 1]])
        cameras.append(Camera(f"cam{i}", SIZE, K, distortion, "radtan", se3.transform(R, -R @ centre)))
    return Rig(tuple(cameras))


def waved(board, frames, seed=0, tilt=0.6):
    """Poses of a board that is waved about in the middle, its face towards the cameras."""
    rng = np.random.default_rng(seed)
    centre = np.append(board.corners[:, :2].mean(axis=0), 0.0)
    Ts = []
    for _ in range(frames):
        facing = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # z of the board along the world's x, y up
        R = se3.exp_so3(np.array([0, 0, np.radians(55)])) @ facing @ se3.exp_so3(rng.uniform(-tilt, tilt, 3))
        Ts.append(se3.transform(R, rng.uniform(-0.5, 0.5, 3) - R @ centre))
    return np.array(Ts)


def looked(rig, board, Ts_world_board, noise=0.15, seed=1, turned=False, moved=None):
    """What the cameras see of it; `turned` names the corners the other way round in half of the views."""
    rng, seen = np.random.default_rng(seed), {}
    for c, camera in enumerate(rig):
        views = []
        for f, T in enumerate(Ts_world_board):
            T = T if moved is None else T @ se3.exp(moved[c, f])
            uv = camera.project(board.corners @ T[:3, :3].T + T[:3, 3])
            if np.isfinite(uv).all() and (uv > 5).all() and (uv < np.array(SIZE) - 5).all():
                ids = np.arange(len(uv))
                if turned and rng.random() < 0.5:
                    ids = board.symmetries[1][ids]
                views.append(BoardView(f, ids, uv + rng.normal(0, noise, uv.shape)))
        seen[camera.name] = CameraViews(SIZE, tuple(views))
    return seen


def test_all_of_it_with_known_truth():
    rig, Ts = studio(), waved(CHECKER, 60)
    Ts[7] = np.eye(4)  # on the floor
    Ts[7, :3, 3] = -0.2, -0.1, 0.0
    found = calibrate_board(looked(rig, CHECKER, Ts), CHECKER, floor=7)
    expected = rig.moved(se3.inverse(Ts[7]))
    for camera, true in zip(found.rig, expected):
        assert camera.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=3e-3)
        assert np.linalg.norm(camera.centre_world - true.centre_world) < 0.012
        turn = se3.log_so3(camera.T_camera_world[:3, :3] @ true.T_camera_world[:3, :3].T)
        assert np.degrees(np.linalg.norm(turn)) < 0.2
    for pair, metres in found.rig.distances.items():
        assert metres == pytest.approx(np.linalg.norm(rig[pair[0]].centre_world - rig[pair[1]].centre_world), rel=4e-3)
    assert found.rms_px == pytest.approx(0.15 * np.sqrt(2), rel=0.15)
    assert "frame 7" in found.world and all(report.views > 30 for report in found.cameras.values())
    assert set(found.shared) == set(itertools.combinations(rig.names, 2))


def test_given_interiors_are_kept_and_the_first_camera_is_the_world():
    rig, Ts = studio(2), waved(CHECKER, 12)
    found = calibrate_board(looked(rig, CHECKER, Ts), CHECKER, interiors=rig)
    for camera, true in zip(found.rig, rig.moved(rig["cam0"].T_camera_world)):
        np.testing.assert_array_equal(camera.matrix, true.matrix)
        np.testing.assert_allclose(camera.T_camera_world, true.T_camera_world, atol=5e-3)
    assert "frame of cam0" in found.world and found.cameras["cam1"].focal_std_px == 0
    assert sum("12 views; record 15" in line for line in found.advice) == 2


def test_one_camera_and_the_floor():
    rig, Ts = studio(1), waved(CHECKER, 25)
    Ts[3] = se3.transform(np.eye(3), np.array([-0.2, -0.1, 0.0]))
    found = calibrate_board(looked(rig, CHECKER, Ts), CHECKER, floor=3)
    expected = rig.moved(se3.inverse(Ts[3]))["cam0"]
    assert np.linalg.norm(found.rig["cam0"].centre_world - expected.centre_world) < 0.015
    assert not found.shared and found.cameras["cam0"].position_std == 0


def test_a_board_that_looks_the_same_upside_down():
    board = Board("checkerboard", (8, 6), 0.05)
    assert len(board.symmetries) == 2
    rig, Ts = studio(), waved(board, 30)
    found = calibrate_board(looked(rig, board, Ts, turned=True), board, interiors=rig)
    for camera, true in zip(found.rig, rig.moved(rig["cam0"].T_camera_world)):
        np.testing.assert_allclose(camera.T_camera_world, true.T_camera_world, atol=4e-3)


def test_cameras_out_of_step_do_not_bend_the_lenses():
    """A board in motion and cameras some milliseconds apart: views disagree by millimetres, each is sharp."""
    rig, Ts = studio(), waved(CHECKER, 50)
    rng = np.random.default_rng(5)
    moved = np.concatenate([rng.normal(0, 3e-3, (3, 50, 3)), rng.normal(0, 6e-3, (3, 50, 3))], axis=2)
    found = calibrate_board(looked(rig, CHECKER, Ts, moved=moved), CHECKER)
    for camera, true in zip(found.rig, rig):
        assert camera.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=5e-3)
    for (a, b), metres in found.rig.distances.items():
        assert metres == pytest.approx(np.linalg.norm(rig[a].centre_world - rig[b].centre_world), rel=0.01)
    assert found.own_rms_px < 0.3 < found.rms_px
    assert 1.5e-3 < found.jitter[0] < 5e-3 and 3e-3 < found.jitter[1] < 1e-2


def test_interiors_alone_need_no_common_frame():
    rig = studio(2)
    seen = looked(rig, CHECKER, waved(CHECKER, 40))
    other = tuple(BoardView(view.frame + 1000, view.ids, view.uv) for view in seen["cam1"].views)
    seen["cam1"] = CameraViews(SIZE, other)
    found = calibrate_board(seen, CHECKER, exteriors=False)
    for camera, true in zip(found.rig, rig):
        assert camera.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.01)
        np.testing.assert_array_equal(camera.T_camera_world, np.eye(4))
    with pytest.raises(CalibrationError, match=r"no frame in which one of cam0 and one of cam1.*Record the board"):
        calibrate_board(seen, CHECKER)


def test_a_bad_view_is_dropped():
    rig = studio(1)
    seen = looked(rig, CHECKER, waved(CHECKER, 25))["cam0"]
    wrong = BoardView(99, seen.views[3].ids, seen.views[3].uv + np.random.default_rng(0).normal(0, 8, (54, 2)))
    found = calibrate_interiors("cam0", CameraViews(SIZE, (*seen.views, wrong)), CHECKER)
    assert 99 not in found.frames and found.rms_px < 0.3


# ---------------------------------------------------------------- derivatives


@pytest.mark.parametrize("interiors", [True, False])
def test_gradient_of_the_cost_against_differences(interiors):
    rig, Ts = studio(2), waved(CHECKER, 4)
    placed = place_cameras(
        {c.name: c.with_pose(np.eye(4)) for c in rig}, looked(rig, CHECKER, Ts, noise=0.05), CHECKER
    )
    problem, sigma = BoardProblem(placed.corners, (1e-3, 2e-3)), np.zeros((2, COLUMNS))
    sigma[1, POSE] = np.inf
    if interiors:
        sigma[:, FOCAL : TIME - 1] = np.inf
    prior, zero = CameraPrior(placed.rig, sigma), np.zeros(2)
    arrow = problem.linearised(BundleState(placed.rig, zero, placed.Ts_world_board), prior)[0]
    assert len(arrow.g) == 6 + 16 * interiors

    def cost(d_camera, d_board):
        rig, _ = prior.moved(placed.rig, zero, d_camera)
        boards = np.stack([T @ se3.exp(d) for T, d in zip(placed.Ts_world_board, d_board)])
        return problem.linearised(BundleState(rig, zero, boards), prior)[1]

    zero_c, zero_b, h = np.zeros(len(arrow.g)), np.zeros((len(placed.Ts_world_board), 6)), 1e-6
    per_camera = np.nonzero(prior.free)[0]
    for k in range(len(zero_c)):
        step = zero_c.copy()
        step[k] = h
        numeric = (cost(step, zero_b) - cost(-step, zero_b)) / (2 * h)
        largest = np.abs(arrow.g[per_camera == per_camera[k]]).max()
        assert -2 * arrow.g[k] == pytest.approx(numeric, rel=2e-3, abs=2e-3 * largest)
    for f, j in itertools.product(range(len(zero_b)), range(6)):
        step = zero_b.copy()
        step[f, j] = h
        numeric = (cost(zero_c, step) - cost(zero_c, -step)) / (2 * h)
        g = arrow.blocks[0].g
        assert -2 * g[f, j] == pytest.approx(numeric, rel=2e-3, abs=2e-3 * np.abs(g[f]).max())


def test_adjustment_of_exact_corners_changes_nothing():
    rig, Ts = studio(2), waved(CHECKER, 6)
    rig = rig.moved(rig["cam0"].T_camera_world)
    Ts = np.stack([studio(2)["cam0"].T_camera_world @ T for T in Ts])
    columns = [
        (c, f, CHECKER.corners, camera.project(CHECKER.corners @ T[:3, :3].T + T[:3, 3]))
        for f, T in enumerate(Ts)
        for c, camera in enumerate(rig)
    ]
    corners = Corners(
        np.repeat([c for c, *_ in columns], 54), np.repeat([f for _, f, *_ in columns], 54),
        np.concatenate([x for *_, x, _ in columns]), np.concatenate([uv for *_, uv in columns]),
    )  # fmt: skip
    found = adjust_boards(rig, Ts, corners, interiors=True)
    assert np.abs(found.residuals).max() < 1e-6
    np.testing.assert_allclose(found.rig["cam1"].T_camera_world, rig["cam1"].T_camera_world, atol=1e-8)


# ---------------------------------------------------------------- pictures


def drawn(board, H, inverted=False, legacy=False, size=SIZE):
    """Picture of a board under a homography of its own frame [m, y up] to pixels."""
    scale, border = 1200.0, 0.05  # [px/m], [m]
    if board.kind == "charuco":
        pattern = cv2.aruco.CharucoBoard(
            board.size, board.square, board.marker,
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}")),
        )  # fmt: skip
        pattern.setLegacyPattern(legacy)
        wide, high = (round(n * board.square * scale) for n in board.size)
        flat = cv2.copyMakeBorder(pattern.generateImage((wide, high)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
        origin = border + board.square
    else:
        columns, rows = (n + 1 for n in board.size)
        squares = np.indices((rows, columns)).sum(axis=0) % 2 == 0  # dark at the top left
        flat = np.where(np.kron(squares, np.ones([int(board.square * scale)] * 2)), 0, 255).astype(np.uint8)
        flat = cv2.copyMakeBorder(flat, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
        origin = border + board.square
    to_flat = np.array([[scale, 0, origin * scale - 0.5], [0, -scale, origin * scale - 0.5], [0, 0, 1]])
    image = cv2.warpPerspective(
        255 - flat if inverted else flat, H @ np.linalg.inv(to_flat), size, flags=cv2.INTER_AREA, borderValue=90
    )
    return cv2.GaussianBlur(image, (3, 3), 0)


def homography(board, turn=0.2, tilt=0.5, shift=(0.0, 0.0)):
    camera = Camera("a", SIZE, [[1100.0, 0, 640], [0, 1100.0, 360], [0, 0, 1]])
    R = se3.exp_so3(np.array([0, 0, turn])) @ se3.exp_so3(np.array([np.pi + 0.2, 0, 0])) @ se3.exp_so3(
        np.array([0, tilt, 0])
    )
    t = np.array([*shift, 0.8]) - R @ np.append(board.corners[:, :2].mean(axis=0), 0)
    return camera.matrix @ np.column_stack([R[:, :2], t])


def pixels(board, H):
    x = np.c_[board.corners[:, :2], np.ones(len(board.corners))] @ H.T
    return x[:, :2] / x[:, 2:]


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_charuco_is_found_inverted_and_from_its_back(inverted, mirrored):
    H = homography(CHARUCO)
    image, expected = drawn(CHARUCO, H, inverted), pixels(CHARUCO, H)
    if mirrored:
        image, expected = image[:, ::-1], np.array([SIZE[0] - 1, 0]) + expected * [-1, 1]
    view = Finder(CHARUCO).find(np.ascontiguousarray(image), 3)
    assert view is not None and view.frame == 3 and view.mirrored == mirrored and len(view.ids) == 24
    assert np.abs(view.uv - expected[view.ids]).max() < 0.4


@pytest.mark.parametrize("turn", [0.1, np.pi / 2, np.pi + 0.1, -1.0])
def test_checkerboard_keeps_its_names_however_it_is_turned(turn):
    """One odd and one even number of corners: the colours tell which end is which."""
    H = homography(CHECKER, turn=turn)
    view = Finder(CHECKER).find(drawn(CHECKER, H), 0)
    assert view is not None
    assert np.abs(view.uv - pixels(CHECKER, H)[view.ids]).max() < 0.4


def test_an_ambiguous_checkerboard_is_found_one_way_or_the_other():
    board = Board("checkerboard", (8, 6), 0.05)
    H = homography(board, turn=3.0)
    view = Finder(board).find(drawn(board, H), 0)
    assert min(np.abs(view.uv - pixels(board, H)[order]).max() for order in board.symmetries) < 0.4


def test_nothing_is_found_in_noise_or_on_another_board():
    noise = np.random.default_rng(0).integers(0, 255, SIZE[::-1], dtype=np.uint8)
    other = drawn(Board("charuco", (5, 7), 0.06, 0.045, "6X6_250"), homography(CHARUCO))
    for image in (noise, other, np.zeros(SIZE[::-1], np.uint8)):
        assert Finder(CHARUCO).find(image, 0) is None
        assert Finder(CHECKER).find(image, 0) is None


@pytest.mark.parametrize(
    ("named", "there"),
    [
        ("charuco:5x7:0.06:0.045:4X4_50", "charuco:5x7:0.06:0.045:5X5"),
        ("charuco:7x5:0.06:0.045:5X5_100", "charuco:5x7:0.06:0.045:5X5"),
        ("checkerboard:8x6:0.05", "checkerboard:9x6"),
        ("checkerboard:10x7:0.05", "checkerboard:9x6"),
    ],
)
def test_the_board_that_is_there_is_named(named, there):
    board = Board.parse(named)
    true = CHARUCO if board.kind == "charuco" else CHECKER
    images = [drawn(true, homography(true))]
    assert str(fitting_boards(board, images)[0]).startswith(there)


def test_dictionary_is_found_out_and_the_legacy_pattern_named():
    board = Board("charuco", (5, 8), 0.05, 0.035, "6X6_50")
    image = drawn(board, homography(board), legacy=True)
    assert Finder(board).find(image, 0) is None
    assert fitting_boards(board, [image])[0].legacy
    blank = Board.parse("charuco:5x7:0.06:0.045")
    assert with_dictionary(blank, [drawn(CHARUCO, homography(CHARUCO))]).dictionary.startswith("5X5")


# ---------------------------------------------------------------- sources


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def test_cameras_out_of_files_and_folders(tmp_path):
    blank = np.zeros((48, 64), np.uint8)
    for name in ("flat/left01.png", "flat/left02.png", "flat/right02.png", "deep/a/x.png", "deep/b/y.jpg", "one/1.png"):
        write(tmp_path / name, blank)
    write(tmp_path / "one/2.png", blank)
    for name in ("1_left.png", "2_left.png", "1_right.png", "2_right.png"):
        write(tmp_path / "before" / name, blank)
    before = camera_sources([tmp_path / "before"])
    assert {name: list(files) for name, files in before.items()} == {"left": [1, 2], "right": [1, 2]}
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "cam1.mp4").touch()
    (tmp_path / "empty").mkdir()
    flat = camera_sources([tmp_path / "flat"])
    assert {name: list(files) for name, files in flat.items()} == {"left": [1, 2], "right": [2]}
    assert list(camera_sources([tmp_path / "deep"])) == ["a", "b"]
    assert list(camera_sources([tmp_path / "one"])["one"]) == [1, 2]
    assert list(camera_sources([tmp_path / "videos"])) == ["cam1"]
    with pytest.raises(FileError, match="no video and no image"):
        camera_sources([tmp_path / "empty"])
    with pytest.raises(FileError, match="no such file"):
        camera_sources([tmp_path / "none"])
    with pytest.raises(CalibrationError, match="two cameras of one name"):
        camera_sources([tmp_path / "one", tmp_path / "one"])


def test_a_part_of_a_larger_board_is_refused(tmp_path):
    larger = Board("checkerboard", (9, 6), 0.05)
    for n, turn in enumerate((0.1, 0.3)):
        write(tmp_path / f"{n}.png", drawn(larger, homography(larger, turn=turn)))
    source = camera_sources([tmp_path])
    try:
        find_boards(source, Board.parse("checkerboard:7x5:0.05"))
    except CalibrationError as error:  # a part was found, or nothing: either way the whole one is named
        assert "checkerboard:9x6:0.05" in str(error)
    else:
        pytest.fail("a part of the board was taken for it")
    assert find_boards(source, larger)[1][tmp_path.name].views


def test_wrong_board_broken_and_mixed_pictures(tmp_path):
    image = drawn(CHARUCO, homography(CHARUCO))
    for camera in "ab":
        write(tmp_path / "good" / camera / "1.png", image)
    wrong = Board.parse("charuco:5x7:0.06:0.045:4X4_50")
    with pytest.raises(CalibrationError, match=r"cameras a, b: no board.*fits --board charuco:5x7:0\.06:0\.045:5X5"):
        find_boards(camera_sources([tmp_path / "good"]), wrong)
    write(tmp_path / "good" / "b" / "1.png", np.zeros(SIZE[::-1], np.uint8))
    with pytest.raises(CalibrationError, match="camera b: .*not found there, but other cameras"):
        find_boards(camera_sources([tmp_path / "good"]), CHARUCO)
    write(tmp_path / "mixed" / "1.png", image)
    write(tmp_path / "mixed" / "2.png", image[:300])
    with pytest.raises(CalibrationError, match=r"2\.png: has 1280x300 px"):
        find_boards(camera_sources([tmp_path / "mixed"]), CHARUCO)
    (tmp_path / "mixed" / "2.png").write_bytes(b"no picture")
    with pytest.raises(FileError, match=r"2\.png: no image"):
        find_boards(camera_sources([tmp_path / "mixed"]), CHARUCO)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "text",
    [
        "", "board", "checkerboard:9:0.02", "checkerboard:9x6", "checkerboard:9x6:0.02:0.01", "checkerboard:1x6:0.02",
        "checkerboard:9x6:25", "checkerboard:9x6:-1", "charuco:5x7:0.04", "charuco:5x7:0.03:0.04",
        "charuco:5x7:0.04:0.03:9X9_50", "charuco:5x7:0.04:0.03:5X5_100:old", "circles:5x7:0.04", "checkerboard:axb:0.1",
        "checkerboard:9x6:nan",
    ],
)  # fmt: skip
def test_a_board_that_cannot_be(text):
    with pytest.raises(CalibrationError, match="checkerboard:COLUMNSxROWS:SQUARE"):
        Board.parse(text)


@pytest.mark.parametrize(
    "text", ["checkerboard:9x6:0.025", "charuco:5x7:0.04:0.03", "charuco:5x7:0.04:0.03:DICT_5X5_100:legacy"]
)
def test_a_board_reads_back(text):
    board = Board.parse(text)
    assert Board.parse(str(board)) == board and len(board.corners) == np.prod(board.grid)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda seen: {**seen, "cam1": CameraViews(SIZE, seen["cam1"].views[:2])}, "camera cam1: only 2 images"),
        (lambda seen: {**seen, "cam1": shuffled(seen["cam1"])}, "contradict each other.*synchronised"),
    ],
)
def test_too_few_and_contradicting_views(change, words):
    rig = studio(2)
    with pytest.raises(CalibrationError, match=words):
        calibrate_board(change(looked(rig, CHECKER, waved(CHECKER, 30))), CHECKER)


def shuffled(seen):
    frames = np.random.default_rng(3).permutation([view.frame for view in seen.views])
    views = (BoardView(int(f), view.ids, view.uv) for f, view in zip(frames, seen.views))
    return CameraViews(seen.size, tuple(sorted(views, key=lambda view: view.frame)))


def test_boards_that_only_face_the_camera_leave_the_focal_length_open():
    rig = studio(1)
    T_world_camera, Ts = rig["cam0"].T_world_camera, []
    rng = np.random.default_rng(0)
    for _ in range(20):
        T = np.eye(4)
        T[:3, :3] = np.diag([1.0, -1, -1]) @ se3.exp_so3(rng.uniform(-0.02, 0.02, 3))
        T[:3, 3] = *rng.uniform(-0.4, 0.2, 2), 2.0
        Ts.append(T_world_camera @ T)
    with pytest.raises(CalibrationError, match=r"cam0: the focal length is not determined.*by \d degrees.*20 to 45"):
        calibrate_board(looked(rig, CHECKER, np.array(Ts)), CHECKER)


def test_floor_and_interiors_that_do_not_fit():
    rig, Ts = studio(2), waved(CHECKER, 12)
    seen = looked(rig, CHECKER, Ts)
    with pytest.raises(CalibrationError, match=r"no camera sees the board in frame 77.*with a board is 11"):
        calibrate_board(seen, CHECKER, interiors=rig, floor=77)
    flipped = Ts.copy()
    flipped[0] = se3.transform(np.diag([1.0, -1, -1]), np.array([-0.2, -0.1, 0.0]))  # face down: its back is seen
    with pytest.raises(CalibrationError, match="in frame 0 the board's face points away from cam0, cam1"):
        calibrate_board(looked(rig, CHECKER, flipped), CHECKER, interiors=rig, floor=0)
    with pytest.raises(CalibrationError, match="no intrinsics of camera 'cam1'; there are: cam0"):
        calibrate_board(seen, CHECKER, interiors=rig.select(("cam0",)))
    with pytest.raises(CalibrationError, match="cam0: its image has 1280x720 px, its intrinsics are of 640x360"):
        calibrate_board(seen, CHECKER, interiors=Rig(tuple(camera.scaled((640, 360)) for camera in rig)))
    squeezed = {name: CameraViews(SIZE, tuple(bent(view) for view in views.views)) for name, views in seen.items()}
    with pytest.raises(CalibrationError, match="no view of the board fits its intrinsics|contradict each other"):
        calibrate_board(squeezed, CHECKER, interiors=rig)
    with pytest.raises(CalibrationError, match="no camera"):
        calibrate_board({}, CHECKER)


def bent(view):
    return BoardView(view.frame, view.ids, view.uv + np.random.default_rng(view.frame).normal(0, 120, view.uv.shape))


# ---------------------------------------------------------------- real recordings


def test_stereo_pair_of_opencv(data_dir):
    folder = data_dir("stereo_opencv_chessboard")
    reference = read_calibration(folder, image_size=(640, 480), unit=0.025)
    board, seen = find_boards(camera_sources([folder]), Board.parse("checkerboard:9x6:0.025"))
    assert [len(views.views) for views in seen.values()] == [13, 13]
    found = calibrate_board(seen, board)
    for camera, true in zip(found.rig, reference):
        assert camera.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.01)
    baseline = np.linalg.norm(reference["right"].centre_world)
    assert found.rig.distances["left", "right"] == pytest.approx(baseline, rel=0.01)
    assert found.rms_px < 0.5


@pytest.mark.slow
def test_four_webcams_see_the_front_and_the_back_of_a_board(data_dir):
    folder = data_dir("mv4_landmarks_caliscope")
    reference = read_calibration(folder / "config.toml")
    interiors = Rig(
        tuple(Camera(f"port_{i}", c.size, c.matrix, c.distortion, c.model) for i, c in enumerate(reference))
    )
    board, seen = find_boards(
        camera_sources([folder / "calibration" / "extrinsic"]), Board.parse("charuco:4x5:0.054:0.0405")
    )
    assert all(view.mirrored for view in seen["port_1"].views) and not seen["port_2"].views[0].mirrored
    found = calibrate_board(seen, board, interiors=interiors)
    for (a, b), metres in found.rig.distances.items():
        centres = [reference[name.replace("port", "cam")].centre_world for name in (a, b)]
        assert metres == pytest.approx(np.linalg.norm(centres[0] - centres[1]), rel=0.01)
    assert found.rms_px < 1.0
