"""The report tells what is doubtful first, why, and never more than the motion knows."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.report.test_cycles import walk
from tests.exporters.report.test_page import own, plots
from tests.exporters.synthetic import a_camera, smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.motion import Residuals, rotation_between_up
from kinefit.errors import ExportError
from kinefit.exporters.report.fit import overall_median, sensor_fits
from kinefit.exporters.report.methods import lengths_table, methods_sentences
from kinefit.exporters.report.moments import (
    doubtful_moments,
    end_variances,
    never_observed,
    probably_far,
    shared_by_prior,
    throughout_sentence,
)
from kinefit.exporters.report.page import band, thinned
from kinefit.exporters.report.report import close_up, report_frames, trust_sentence, write_report
from kinefit.exporters.tables import curves
from kinefit.findings import listed, runs_of
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.simulation import cut, known_motion

F = 80


def good_motion(frames=F, offsets=((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))):
    """A motion that three cameras see well: residuals of about 3 px, nothing doubtful."""
    rng = np.random.default_rng(3)
    motion = smooth_motion(frames)
    points = motion.body.keypoints("BODY_25B")
    residuals = {}
    for k, offset in enumerate(offsets):
        values = rng.normal(0, 2.5, (frames, len(points), 2)) + offset
        seen = a_camera(f"cam{k}", 0.7 * k).project(motion.positions(points))
        residuals[f"cam{k}"] = Residuals(
            points.names, points.segments, values, np.ones(values.shape[:2]), "px", seen, np.zeros(frames, bool)
        )
    return replace(
        motion, residuals=residuals, quality=np.full(frames, 0.9), dof_std=np.full_like(motion.dof_std, 0.02),
        segment_quality=np.ones_like(motion.segment_quality), joint_std=np.full_like(motion.joint_std, 0.008),
        times=np.arange(frames) / 60.0,
    )  # fmt: skip


def changed(motion, name, rows, columns, value):
    """The motion with part of one of its arrays set."""
    array = np.array(getattr(motion, name))
    array[rows, columns] = value
    return replace(motion, **{name: array})


def changed_residuals(motion, camera, rows, columns, **values):
    """The motion with part of a camera's residuals set."""
    r = motion.residuals[camera]
    arrays = {name: np.array(getattr(r, name)) for name in values}
    for name, value in values.items():
        arrays[name][(rows, columns) if arrays[name].ndim > 1 else rows] = value
    return replace(motion, residuals={**motion.residuals, camera: replace(r, **arrays)})


def segment(motion, name):
    return motion.body.tree.segments.index(name)


def columns_of(motion, name):
    return np.flatnonzero(np.asarray(motion.residuals["cam0"].segments) == segment(motion, name))


def page_of(motion, tmp_path, **options):
    return write_report(motion, tmp_path / "report.html", date="2026-01-01", **options).read_text("utf-8")


# Doubtful moments


def test_a_good_motion_has_no_doubtful_moment():
    assert doubtful_moments(good_motion()) == ()
    assert trust_sentence(good_motion(), ()).endswith("no doubtful moment.")


def test_a_segment_that_hardly_anything_observes_is_told_with_the_cameras_that_saw_it():
    motion = changed(good_motion(), "segment_quality", slice(20, 30), segment(good_motion(), "hand_r"), 0.0)
    motion = changed(motion, "joint_std", slice(20, 30), segment(motion, "hand_r"), 0.08)
    motion = changed(motion, "dof_std", slice(20, 30), 6 + motion.body.tree.coordinate("wrist_dev_r"), np.inf)
    hidden = np.concatenate([columns_of(motion, name) for name in ("forearm_r", "hand_r")])
    for camera in ("cam0", "cam1"):
        motion = changed_residuals(motion, camera, slice(20, 30), hidden, values=np.nan, weights=0.0)
    (moment,) = doubtful_moments(motion)
    assert (moment.start, moment.stop) == (20, 30) and set(moment.segments) == {"hand_r", "forearm_r"}
    assert moment.what[0].startswith("The position of right forearm and right hand is uncertain: up to ±")
    assert moment.causes == ("Only cam2 saw it.", "No measurement supports right hand.")


def test_what_is_contradicted_but_certain_is_lost_and_no_doubt():
    motion = changed(good_motion(), "segment_quality", slice(20, 30), segment(good_motion(), "hand_r"), 0.3)
    assert motion.lost[20:30, segment(motion, "hand_r")].all() and not doubtful_moments(motion)


def test_a_limb_that_most_views_show_elsewhere_for_a_while_is_told():
    motion = good_motion()
    hand = columns_of(motion, "hand_r")
    for camera in ("cam0", "cam1"):
        motion = changed_residuals(motion, camera, slice(40, 60), hand, values=300.0, weights=0.0)
        motion = changed_residuals(motion, camera, [70], hand, values=300.0, weights=0.0)  # an outlier is alone
    motion = changed_residuals(motion, "cam1", slice(42, 44), None, swapped=True)
    (moment,) = doubtful_moments(motion)
    assert abs(moment.start - 41) <= 1 and abs(moment.stop - 59) <= 1 and moment.segments == ("hand_r",)
    assert moment.what == ("Most views show right hand more than 8 cm away from the body.",)
    assert moment.causes == (
        "67 % of its keypoints were rejected as outliers, most of them in cam0.",
        "The detector swapped left and right in cam1 (corrected).",
    )
    one = changed_residuals(good_motion(), "cam2", slice(40, 60), hand, values=300.0, weights=0.0)
    assert not doubtful_moments(one)


def test_a_stretch_without_anybody_comes_first():
    quality = np.full(F, 0.9)
    quality[10:30] = 0.0
    motion = changed(replace(good_motion(), quality=quality), "joint_std", slice(50, 52), 0, 0.1)
    moments = doubtful_moments(motion)
    assert [(m.start, m.stop) for m in moments] == [(10, 30), (50, 52)]
    assert "The person was not observed" in moments[0].what[0]


def test_a_wide_error_bar_is_a_moment_or_told_of_the_whole_take():
    motion = good_motion()
    toes = segment(motion, "toes_r")
    wide = changed(motion, "joint_std", slice(5, 9), toes, 0.1)
    (moment,) = doubtful_moments(wide)
    assert set(moment.segments) == {"toes_r", "foot_r"} and (moment.start, moment.stop) == (5, 9)
    assert moment.what == ("The position of right foot and right toes is uncertain: up to ±35 cm (2 σ).",)
    assert throughout_sentence(motion) == throughout_sentence(wide) == ""
    always = changed(motion, "joint_std", slice(None), toes, 0.1)
    assert doubtful_moments(always) == ()
    assert throughout_sentence(always).replace("\u00a0", " ") == "right foot (±35 cm) and right toes (±35 cm)"
    (moment,) = doubtful_moments(changed(always, "joint_std", slice(5, 9), toes, 0.3))
    assert (moment.start, moment.stop) == (5, 9)
    everywhere = changed(motion, "joint_std", slice(None), slice(None), 0.1)
    assert throughout_sentence(everywhere).startswith("the whole body (±35 to ")
    unbounded = changed(motion, "joint_std", slice(5, 9), toes, np.inf)
    assert not doubtful_moments(unbounded)  # the joint itself is as known as the one before it
    unbounded = changed(unbounded, "dof_std", slice(5, 9), 6 + motion.body.tree.coordinate("knee_angle_r"), np.inf)
    assert "unbounded in at least one direction" in doubtful_moments(unbounded)[0].what[0]


def test_what_happens_at_once_is_one_moment_and_near_ones_are_joined():
    motion = changed(good_motion(), "joint_std", [20, 21, 23, 24], segment(good_motion(), "hand_r"), 0.1)
    (moment,) = doubtful_moments(motion)
    assert (moment.start, moment.stop) == (20, 25) and set(moment.segments) == {"hand_r", "forearm_r"}
    assert "right forearm and right hand" in moment.what[0]


def test_coordinates_without_any_measurement_are_named():
    motion = good_motion()
    std = np.array(motion.dof_std)
    std[:, 6 + motion.body.tree.coordinate("wrist_dev_l")] = np.inf
    std[:10, 6 + motion.body.tree.coordinate("knee_angle_l")] = np.inf
    assert never_observed(replace(motion, dof_std=std)) == ("wrist_dev_l",)


def test_angles_that_share_a_bend_by_the_prior_are_named_and_why(tmp_path):
    motion = good_motion()
    std, tree = np.array(motion.dof_std), motion.body.tree
    shared = ("lumbar_extension", "thorax_extension", "hip_flexion_r", "hip_flexion_l")
    std[:, [6 + tree.coordinate(name) for name in shared]] = np.radians(8.0)
    std[:10, 6 + tree.coordinate("thorax_extension")] = np.inf
    unsure = replace(motion, dof_std=std)
    assert {name: round(v, 6) for name, v in shared_by_prior(unsure).items()} == dict.fromkeys(shared, 8.0)
    page = write_report(unsure, tmp_path / "report.html", date="2026-01-01").read_text(encoding="utf-8")
    assert "Shares from the reference pose" in page and "right hip flexion (±16°)" in page
    std[:, 6 + tree.coordinate("hip_flexion_l")] = np.radians(1.0)  # markers on the pelvis tell how the hips turn
    assert shared_by_prior(replace(motion, dof_std=std)) == {}
    assert "Shares from the reference" not in write_report(motion, tmp_path / "r.html").read_text(encoding="utf-8")


def test_stretches_and_lists():
    flags = np.array([1, 0, 1, 1, 0, 0, 0, 1], bool)
    assert runs_of(flags) == [(0, 1), (2, 4), (7, 8)]
    assert runs_of(flags, gap=2) == [(0, 4), (7, 8)]
    assert runs_of(np.zeros(5, bool)) == []
    assert listed(["a"]) == "a" and listed(["a", "b", "c"]) == "a, b and c"
    assert listed("abcdefg", 4) == "a, b, c, d and 3 more"


# Fit


def test_numbers_of_a_sensor_are_those_of_its_residuals():
    motion = changed_residuals(good_motion(), "cam0", slice(0, 8), slice(None), values=np.nan, weights=0.0)
    motion = changed_residuals(motion, "cam0", slice(8, 16), slice(None), weights=0.0)
    fit = sensor_fits(motion)[0]
    norms = np.linalg.norm(motion.residuals["cam0"].values[8:], axis=-1)
    assert fit.median == pytest.approx(np.median(norms)) and fit.most == pytest.approx(np.percentile(norms, 95))
    assert fit.seen == pytest.approx(0.9) and fit.left_out == pytest.approx(8 / 72) and fit.count == norms.size
    assert overall_median(motion) == pytest.approx(np.nanmedian([r.norms for r in motion.residuals.values()]))
    assert motion.residuals["cam0"].median_text(norms[:0]) == "no data"


def test_a_constant_shift_points_to_the_calibration(tmp_path):
    shifted = [f.is_shifted for f in sensor_fits(good_motion(offsets=((0, 0), (-14, 3), (0.5, 0))))]
    assert shifted == [False, True, False]
    text = page_of(good_motion(offsets=((0, 0), (-14, 3), (0, 0))), tmp_path)
    assert re.search(r"Constant shift in cam1 \(-1\d\.\d, \+\d\.\d\) px", text) and "kinefit check" in text
    assert "Constant shift" not in page_of(good_motion(), tmp_path)


def test_the_probability_of_five_centimetres_is_that_of_the_error_bars():
    motion = smooth_motion(5)
    motion = replace(motion, dof_std=np.full_like(motion.dof_std, 1e-6))
    for std in ([0.03, 0.03, 0.03], [0.04, 1e-6, 1e-6], [0.02, 0.05, 0.03]):
        found = probably_far(end_variances(replace(motion, joint_std=np.broadcast_to(std, motion.joint_std.shape))))
        draws = np.linalg.norm(np.random.default_rng(0).normal(0.0, std, (200_000, 3)), axis=1)
        assert found == pytest.approx(np.mean(draws > 0.05), abs=0.02)
    knee = np.full(motion.joint_std.shape, 0.01)
    knee[:, motion.body.tree.segment("shank_l")] = 0.1  # an end of the thigh, too
    far = probably_far(end_variances(replace(motion, joint_std=knee))) > 0.5
    assert (probably_far(np.zeros((2, 3, 3))) == 0.0).all()
    names = [name for name, own in zip(motion.body.tree.segments, far.all(axis=0)) if own]
    assert names == ["thigh_l", "shank_l"] and not far[:, motion.body.tree.segment("foot_l")].any()


# Angles


@pytest.mark.parametrize("up", ["y", "z"])
def test_slopes_of_all_coordinates_are_their_derivatives_by_the_motions_own(up):
    motion = smooth_motion(6, up=up)
    std = np.array([0.01, 0.02, 0.03])
    motion = replace(motion, dof_std=np.concatenate([np.zeros((6, 3)), np.tile(std, (6, 1)), motion.dof_std[:, 6:]], 1))
    for k, unit in enumerate(np.eye(6)):
        both = []
        for step in (1e-6, -1e-6):
            T = motion.Ts_world_root.copy()
            T[:, :3, :3] = se3.exp_so3(step * unit[3:]) @ T[:, :3, :3]
            T[:, :3, 3] += step * unit[:3]
            both.append(curves(replace(motion, Ts_world_root=T)))
        for one, plus, minus in zip(curves(motion), *both):
            slope = one.slopes[:, one.coordinates.index(k)] if k in one.coordinates else 0.0
            assert np.allclose((plus.values - minus.values) / 2e-6, slope, atol=1e-4), one.name
    tilt = next(c for c in curves(motion.turned("y")) if c.name == "pelvis_tilt")
    R = rotation_between_up(up, "y")
    assert np.allclose(tilt.std, np.sqrt(tilt.slopes**2 @ (np.abs(R) @ std) ** 2), rtol=1e-5)
    blind = np.array(motion.dof_std)
    blind[2, 4] = np.inf
    assert np.isinf(next(c for c in curves(replace(motion, dof_std=blind)) if c.name == "pelvis_tilt").std[2])


def test_all_coordinates_are_there_in_degrees():
    motion = smooth_motion(20)
    found = {c.name: c for c in curves(motion)}
    assert len(found) == 6 + len(motion.body.tree.coordinates)
    d = motion.body.tree.coordinate("knee_angle_r")
    knee = found["knee_angle_r"]
    assert np.allclose(knee.values, np.degrees(np.unwrap(motion.angles[:, d]))) and knee.side == "right"
    assert np.allclose(knee.std, np.degrees(motion.dof_std[:, 6 + d])) and knee.joint == "knee"


def test_thinning_keeps_the_extremes():
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, 10_000)
    values[[1234, 8765]] = 50, -50
    at = thinned(values, 1000)
    assert len(at) <= 1002 and {0, 1234, 8765, 9999} <= set(at.tolist()) and np.all(np.diff(at) > 0)
    assert np.array_equal(thinned(values[:900], 1000), np.arange(900))


def test_a_band_leaves_out_what_nothing_observes():
    [trace] = band(np.arange(6.0), np.zeros(6), np.array([1, 1, np.nan, np.nan, 2, 2.0]), "left", "#0072b2")
    x, y = trace["x"], trace["y"]
    assert x.tolist()[:4] == [0, 1, 1, 0] and np.isnan(x[4]) and x.tolist()[5:] == [4, 5, 5, 4]
    assert y.tolist()[:4] == [1, 1, -1, -1] and y.tolist()[5:] == [2, 2, -2, -2]
    assert band(np.arange(2.0), np.zeros(2), np.full(2, np.nan), "left", "#0072b2") == []


# The page


def test_the_page_has_its_parts_and_no_address_and_no_nan(tmp_path):
    motion = replace(smooth_motion(60), name="a walk")
    text = page_of(motion, tmp_path, rig=Rig((a_camera("cam 0", 0.0),)), files={"motion.npz": "everything"})
    titles = re.findall(r"<h2>([^<]*)</h2>", text)
    assert titles == ["Summary", "Moving figure", "Angles", "Cycles", "Doubtful moments", "Fit to the measurements",
                      "Methods", "Files"]  # fmt: skip
    assert "://" not in own(text) and "<h1>a walk</h1>" in text and 'href="motion.npz"' in text
    assert plots(text)  # json.loads of the tests takes NaN; the text has none
    assert not re.search(r"\bNaN\b|\bInfinity\b|>nan|>inf", own(text).split("<script>")[0])


def test_the_same_motion_gives_the_same_bytes(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (90, 60, 3)).astype(np.uint8)
    pages = []
    for name in ("a", "b"):
        pictures = {"cam0": dict.fromkeys(report_frames(smooth_motion(30)), image)}
        path = write_report(smooth_motion(30), tmp_path / name / "r.html", date="x", pictures=pictures)
        pages.append(path.read_bytes())
    assert pages[0] == pages[1]


def test_doubt_comes_before_results_and_names_its_severity(tmp_path):
    bad = replace(good_motion(), quality=np.zeros(F), segment_quality=np.zeros((F, 20)))
    text = page_of(bad, tmp_path, findings=[("warning", "Found by the check", "cam0 is late")])
    assert '<div class="callout bad">' in text and "In 100 % of the frames no person was observed." in text
    assert text.index("In 100 %") < text.index("Found by the check") < text.index('id="angles"')
    assert '<a href="#doubtful-moments">where and why</a>' in text
    assert '<div class="callout good">' in page_of(good_motion(), tmp_path)


def lines(text):
    """The five lines of the summary, by their names."""
    short = text[text.index("In short"):]
    short = short[:short.index("</div></div>")]
    found = re.findall(r"<p><strong>([^<]*): </strong>(.*?)</p>", short)
    return {name: re.sub("<[^>]*>", "", line) for name, line in found}


def test_the_page_begins_with_what_was_found_how_sure_and_what_to_do(tmp_path):
    motion = smooth_motion(60)
    motion = replace(motion, quality=np.ones(60), dof_std=np.full_like(motion.dof_std, np.radians(2.0)))
    text = page_of(motion, tmp_path)
    found = lines(text)
    assert list(found) == ["Recorded", "Moved most", "Left and right", "How sure", "What to do"]
    assert "60 frames" in found["Recorded"] and "tracked in 100 %" in found["Recorded"]
    assert found["Moved most"].count("±") == 3 and "range of motion [°]" in text
    assert "nothing. The subject" in found["What to do"]
    assert "were independent: an upper bound" in text  # it tells no errors that frames share
    first = np.zeros(60, int)
    angles = motion.angles[first] + 0.1 * motion.angles
    still = replace(motion, angles=angles, Ts_world_root=motion.Ts_world_root[first])
    unsure = page_of(replace(still, dof_std=np.full_like(motion.dof_std, np.radians(40.0))), tmp_path)
    assert lines(unsure)["Moved most"] == "no angle moved by twice its error bar."
    assert "range of motion [°]" not in unsure and "Moved less than their error bars: " in unsure


def test_a_side_that_moves_farther_is_told(tmp_path):
    motion = smooth_motion(60)
    angles, knee = np.array(motion.angles), motion.body.tree.coordinate("knee_angle_l")
    angles[:, knee] = 0.8 + 0.7 * np.sin(np.linspace(0, 6, 60))
    angles[:, motion.body.tree.coordinate("knee_angle_r")] = 0.8
    motion = replace(motion, angles=angles, quality=np.ones(60), dof_std=np.full_like(motion.dof_std, np.radians(1.0)))
    assert "knee flexion (80 ± 4°)" in lines(page_of(motion, tmp_path))["Left and right"]


def test_a_walk_has_cycles_and_another_motion_none(tmp_path):
    text = page_of(walk(), tmp_path)
    assert "Gait: " in text and "stride time [s]" in text and "stride length [m]" in text
    text = page_of(good_motion(), tmp_path)
    assert "This take has no repeated cycle." in text and "cycle [%]" not in text


def everything_inf(motion):
    return replace(motion, dof_std=np.inf * motion.dof_std, joint_std=np.inf * motion.joint_std)


def nothing_seen(motion):
    gone = {n: replace(r, values=r.values * np.nan, weights=0 * r.weights, measured=r.measured * np.nan)
            for n, r in motion.residuals.items()}  # fmt: skip
    return replace(motion, residuals=gone)


def a_still_arm(motion):
    body = load_body("arm")
    return known_motion(body, 60.0, np.tile(np.eye(4), (30, 1, 1)), np.zeros((30, len(body.tree.coordinates))))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m: cut(m, 0, 1), "1 frames at 60 Hz"), (lambda m: cut(m, 0, 2), "2 frames"),
        (lambda m: replace(m, residuals={}), "has no measurements"), (everything_inf, "Not observed: root tx"),
        (nothing_seen, "no data"), (a_still_arm, "has no measurements"),
    ],
)  # fmt: skip
def test_poor_motions_have_a_page_that_says_so(tmp_path, change, told):
    text = page_of(change(good_motion()), tmp_path)
    assert told in text and plots(text)
    assert not re.search(r"\bNaN\b|>nan|>inf| nan ", own(text).split("<script>")[0])


def test_what_nothing_observes_has_no_band_and_is_grey(tmp_path):
    for motion, has_band in ((everything_inf(good_motion()), False), (good_motion(), True)):
        drawn = [plot for plot in plots(page_of(motion, tmp_path)) if "layout" in plot]
        hip = next(plot for plot in drawn if "hip_flexion" in json.dumps(plot["layout"]))
        assert any("fill" in trace for trace in hip["data"]) is has_band
        assert ("not observed: " in hip["layout"]["annotations"][0]["text"]) is not has_band


def test_a_motion_without_frames_is_refused_and_nothing_is_left(tmp_path):
    names = ("times", "Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")
    motion = good_motion()
    empty = replace(motion, residuals={}, **{name: getattr(motion, name)[:0] for name in names})
    with pytest.raises(ExportError, match="without frames"):
        write_report(empty, tmp_path / "report.html")
    assert not list(tmp_path.iterdir())
    assert report_frames(empty) == {} and never_observed(empty) == () and shared_by_prior(empty) == {}


@pytest.mark.slow
def test_a_long_take_stays_small(tmp_path):
    assert write_report(smooth_motion(10_000), tmp_path / "r.html", rig=None).stat().st_size < 8e6


# Pictures, methods


def test_the_frames_to_show_are_the_first_the_middle_the_last_and_the_worst():
    quality = np.full(F, 0.9)
    quality[17] = 0.2
    frames = report_frames(replace(good_motion(), quality=quality))
    assert frames == {0: "first", F // 2: "middle", F - 1: "last", 17: "lowest quality"}


def test_a_close_up_shows_the_person_and_what_does_not_see_it_is_left_whole():
    motion, image = good_motion(), np.full((480, 320, 3), 90, np.uint8)
    camera = a_camera("cam0", 0.3)
    close = close_up(image, motion, 0, camera, residuals=motion.residuals["cam0"])
    assert close.shape[0] < 480 and (close != 90).any() and (image == 90).all()
    away = camera.with_pose(se3.transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)) @ camera.T_camera_world)
    assert close_up(image, motion, 0, away).shape == image.shape


def test_pictures_stand_beside_their_moment(tmp_path):
    motion = changed(good_motion(), "joint_std", slice(33, 36), segment(good_motion(), "hand_r"), 0.1)
    worst = doubtful_moments(motion)[0].worst
    pictures = {"cam2": dict.fromkeys(report_frames(motion), np.full((90, 60, 3), 9, np.uint8))}
    assert worst in pictures["cam2"]
    text = page_of(motion, tmp_path, pictures=pictures)
    doubtful = text[text.index('id="doubtful-moments"') : text.index('id="fit-to-the-measurements"')]
    assert f"cam2, frame {worst}" in doubtful and doubtful.count("<img") == 1
    shown = text[text.index('<section id="images"') : text.index('<section id="methods"')]
    assert shown.count("<img") == 3


def test_methods_tell_what_the_provenance_knows_and_no_more(tmp_path):
    motion = good_motion()
    bare = " ".join(methods_sentences(motion, 0))
    assert "cam0, cam1 and cam2" in bare and "No moment was flagged" in bare
    assert "estimated together" not in bare and "SHA-256" not in bare
    told = {
        "kinefit": "9.9", "tracking": {"poor": 0.5},
        "smoothing": {"acceleration_memory": 0.2, "pixel_sigma": {"cam0": {"nose": 4.0, "neck": 5.0}}},
        "calibration": {"file": "calib.toml", "sha256": "ab" * 32},
        "keypoints": [{"camera": "cam0", "format": "openpose", "set": "BODY_25B", "accuracy": 8.0}],
    }  # fmt: skip
    text = " ".join(methods_sentences(replace(motion, provenance=told), 3))
    for part in (
        "kinefit 9.9", "(OpenPose (Cao et al. 2021, IEEE TPAMI 43:172) BODY_25B)",
        "a stated standard deviation of 8 px", "calib.toml (SHA-256 abababababababab…)",
        "random joint accelerations that last 0.2 s; ", "every keypoint (median 4.5 px) was estimated",
            "poor 0.5", "3 moments were",
    ):  # fmt: skip
        assert part in text, part
    page = page_of(replace(motion, provenance=told), tmp_path)
    block = json.loads(re.search(r"<pre>(.*?)</pre>", page, re.S)[1].replace("&quot;", '"'))
    assert block["provenance"] == told and block["sensors"]["cam0"]["unit"] == "px" and block["frames"] == F


def test_lengths_are_in_centimetres_with_deviations_where_known():
    motion = good_motion()
    length = 100 * motion.body.segment_lengths()["thigh_l-shank_l"]
    assert f"<td>{length:.1f}</td>" in lengths_table(motion)
    told = replace(motion, provenance={"length_std_m": {"thigh_l-shank_l": 0.012}})
    assert f"<td>{length:.1f} ± 1.2</td>" in lengths_table(told)


def test_one_camera_is_one_sensor_and_nothing_uncertain_is_in_order(tmp_path):
    motion = good_motion(offsets=((0.0, 0.0),))
    seen = motion.residuals["cam0"]
    x = np.zeros((F, len(seen.names), 3))
    lifted = replace(seen, unit="m", values=x, measured=x + 1.0)
    both = replace(motion, residuals={"cam0": seen, "lifted cam0": lifted})
    page = write_report(both, tmp_path / "a.html").read_text()
    assert "<dt>Sensors</dt><dd>1</dd>" in page and "Markers of" not in page and 'class="callout good"' in page
    wide = replace(both, joint_std=np.full_like(motion.joint_std, 0.365))
    page = write_report(wide, tmp_path / "b.html").read_text()
    assert "the whole body (±" in page and 'class="callout good"' not in page
