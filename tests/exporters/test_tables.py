"""CSV and Parquet hold what the motion holds."""

import csv
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.errors import ExportError
from kinefit.exporters import tables, write_csv, write_parquet
from kinefit.geometry import se3

NAMES = ["angles", "joints", "landmarks", "quality", "residuals"]


def read_csv(path):
    with open(path, newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    return {name: list(column) for name, column in zip(head, zip(*rows))}


def numbers(column):
    return np.array([float(v) if v else np.nan for v in column])


def test_csv_holds_the_motion(tmp_path):
    motion = smooth_motion(20, up="z")
    files = write_csv(motion, tmp_path)
    assert [f.name for f in files] == [f"{name}.csv" for name in NAMES] and all(f.is_file() for f in files)
    angles, joints, landmarks, quality, _ = (read_csv(f) for f in files)
    tree = motion.body.tree
    assert numbers(angles["frame"]).tolist() == list(range(20))
    assert numbers(angles["time [s]"]) == pytest.approx(motion.times)
    d = tree.coordinate("knee_angle_r")
    assert numbers(angles["knee_angle_r [deg]"]) == pytest.approx(np.degrees(motion.angles[:, d]))
    assert numbers(angles["knee_angle_r std [deg]"]) == pytest.approx(np.degrees(motion.dof_std[:, 6 + d]))
    assert angles["lumbar_extension std [deg]"][3] == "inf"
    assert numbers(angles["root_ty [m]"]) == pytest.approx(motion.Ts_world_root[:, 1, 3])
    assert numbers(angles["root_ry std [deg]"]) == pytest.approx(np.degrees(motion.dof_std[:, 4]))
    quaternion = np.stack([numbers(angles[f"root_q{part}"]) for part in "wxyz"], 1)
    assert np.abs(se3.rotation_from_quaternion(quaternion) - motion.Ts_world_root[:, :3, :3]).max() < 1e-7
    s = tree.segment("shank_l")
    assert numbers(joints["knee_l z [m]"]) == pytest.approx(motion.segment_poses()[:, s, 2, 3])
    assert numbers(joints["knee_l z std [m]"]) == pytest.approx(motion.joint_std[:, s, 2])
    k = motion.body.landmarks.index("r_heel")
    assert numbers(landmarks["r_heel x [m]"]) == pytest.approx(motion.positions()[:, k, 0])
    assert numbers(quality["shank_l"]) == pytest.approx(motion.segment_quality[:, s])
    assert numbers(quality["quality"]) == pytest.approx(motion.quality)


def test_residuals_are_in_long_form(tmp_path):
    motion = smooth_motion(20)
    write_csv(motion, tmp_path)
    table = read_csv(tmp_path / "residuals.csv")
    assert len(table["frame"]) == sum(np.isfinite(r.norms).sum() for r in motion.residuals.values())
    r = motion.residuals["cam 1"]
    frame, point = np.argwhere(np.isfinite(r.norms))[37]
    found = [
        i for i, key in enumerate(zip(table["sensor"], table["frame"], table["point"]))
        if key == ("cam 1", str(frame), r.names[point])
    ]  # fmt: skip
    assert len(found) == 1
    row = {name: column[found[0]] for name, column in table.items()}
    assert float(row["residual"]) == pytest.approx(r.norms[frame, point])
    assert float(row["measured v [px]"]) == pytest.approx(r.measured[frame, point, 1])
    assert float(row["residual u [px]"]) == pytest.approx(r.values[frame, point, 0])
    assert row["residual x [m]"] == "" and row["unit"] == "px"
    assert row["segment"] == motion.body.tree.segments[r.segments[point]]
    assert row["left_right_swapped"] == ("true" if r.swapped[frame] else "false")
    assert {"px", "m"} == set(table["unit"])


def test_the_quaternion_of_the_root_does_not_change_its_sign():
    angles = tables(smooth_motion(300, turns=3.0))["angles"]
    quaternion = np.stack([angles[f"root_q{part}"] for part in "wxyz"], 1)
    assert np.sum(quaternion[1:] * quaternion[:-1], axis=1).min() > 0.98
    assert quaternion[:, 0].min() < -0.9


def test_residuals_of_surfaces_are_told_by_segments(tmp_path):
    motion = smooth_motion(20)
    r = motion.residuals["cam 1"]
    shape, random = r.values.shape[:2], np.random.default_rng(0)
    values, rms = random.normal(0.0, 0.01, (*shape, 1)), random.uniform(0.01, 0.02, shape)
    values[0, 0] = np.nan
    surface = replace(
        r, values=values, measured=np.full_like(values, np.nan), unit="m", rms=rms, count=np.full(shape, 7)
    )
    write_csv(replace(motion, residuals={"cam 0": motion.residuals["cam 0"], "depth": surface}), tmp_path)
    table = read_csv(tmp_path / "residuals.csv")
    mine = [k for k, sensor in enumerate(table["sensor"]) if sensor == "depth"]
    assert len(mine) == values.size - 1
    row = {name: column[mine[0]] for name, column in table.items()}
    assert (row["frame"], row["point"], row["unit"], float(row["count"])) == ("0", r.names[1], "m", 7.0)
    assert float(row["residual median [m]"]) == pytest.approx(values[0, 1, 0], rel=1e-4)
    assert float(row["residual rms [m]"]) == pytest.approx(rms[0, 1], rel=1e-4)
    assert row["residual u [px]"] == ""


def test_names_with_commas_and_no_residuals(tmp_path):
    motion = smooth_motion(3)
    odd = {'cam "a", left': motion.residuals["cam 0"]}
    write_csv(replace(motion, residuals=odd), tmp_path)
    assert set(read_csv(tmp_path / "residuals.csv")["sensor"]) == set(odd)
    write_csv(replace(motion, residuals={}), tmp_path)
    assert (tmp_path / "residuals.csv").read_text().startswith("frame,time [s],sensor,point")
    assert len((tmp_path / "residuals.csv").read_text().splitlines()) == 1


def test_parquet_holds_the_same(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    motion = smooth_motion(20)
    files = write_parquet(motion, tmp_path)
    assert [f.name for f in files] == [f"{name}.parquet" for name in NAMES]
    for file, (name, table) in zip(files, tables(motion).items()):
        back = parquet.read_table(file)
        assert back.column_names == list(table), name
        assert back.schema.metadata[b"up"] == b"y"
        for column, values in table.items():
            np.testing.assert_array_equal(back[column].to_numpy(), values)


def test_parquet_names_its_extra_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ExportError, match=r"kinefit\[parquet\]"):
        write_parquet(smooth_motion(2), tmp_path)
    assert not list(tmp_path.iterdir())


def test_pieces_of_any_length_give_the_same_files(tmp_path, monkeypatch):
    module = import_module("kinefit.exporters.tables")  # the package has a function of this name
    motion = smooth_motion(40)
    whole = write_csv(motion, tmp_path / "whole")
    monkeypatch.setattr(module, "_ROWS", 7)
    monkeypatch.setattr(module, "_FRAMES", 3)
    for one, other in zip(whole, write_csv(motion, tmp_path / "pieces"), strict=True):
        assert one.read_bytes() == other.read_bytes()
