"""Surfaces as CSV, VTK and pictures: what is written reads back."""

import csv

import cv2
import numpy as np
import pytest

from kinefit.errors import ExportError
from kinefit.exporters.surface_files import (
    point_columns,
    write_field_picture,
    write_paths_csv,
    write_point_picture,
    write_points_csv,
    write_surface_vtk,
)
from kinefit.images.photogrammetry.least_squares_matching import Grid
from kinefit.images.photogrammetry.strain import strain
from kinefit.images.photogrammetry.surface import MeasuredSurface
from kinefit.images.photogrammetry.trajectories import Trajectories


@pytest.fixture
def surfaces():
    """A sheet of 8 x 6 points, one of them missing, and the same one stretched by a hundredth along x."""
    grid = Grid.of((80, 60), 10)
    n = len(grid.points)
    x = np.column_stack([grid.points * 1e-3, np.full(n, 0.5)])
    x[9] = np.nan

    def made(x):
        uv = np.repeat(grid.points[:, None], 2, axis=1)
        return MeasuredSurface(
            grid, ("a", "b"), x, np.tile(1e-8 * np.eye(3), (n, 1, 1)), uv, np.full(n, 0.99), np.full(n, 0.1),
            np.tile(np.eye(2), (n, 1, 1, 1)),
        )  # fmt: skip

    return made(x), made(x * (1.01, 1.0, 1.0))


def test_a_table_has_a_row_for_each_measured_point(surfaces, tmp_path):
    first, second = surfaces
    told = strain(first.x_world, second.x_world - first.x_world, 8, gauge=0.04)
    write_points_csv(second, tmp_path / "points.csv", point_columns(second, first, told, window=13))
    with (tmp_path / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 47 and (rows[9]["row"], rows[9]["column"]) == ("1", "2")  # the missing one is 1, 1
    assert float(rows[3]["dx_m"]) == pytest.approx(0.01 * 0.03) and float(rows[3]["std_x_m"]) == pytest.approx(1e-4)
    middle = next(row for row in rows if row["row"] == "3" and row["column"] == "4")
    assert float(middle["strain_xx"]) == pytest.approx(0.5 * (1.01**2 - 1))
    assert float(middle["std_dx_m"]) < 1e-9  # neighbours agree; a corner has too few, and those of the matches
    assert float(rows[0]["std_dx_m"]) == pytest.approx(np.sqrt(2) * 1e-4)


def read_vtk(path):
    """Points, triangles and scalars of a binary legacy file, read anew here."""
    data, out, at = path.read_bytes(), {}, 0

    def line():
        nonlocal at
        end = data.index(b"\n", at)
        words, at = data[at:end].decode().split(), end + 1
        return words

    def numbers(count, kind):
        nonlocal at
        size = np.dtype(kind).itemsize * count
        values = np.frombuffer(data[at : at + size], kind)
        at += size
        return values

    assert data.startswith(b"# vtk DataFile Version 3.0\n")
    while at < len(data):
        words = line()
        if words[:1] == ["POINTS"]:
            out["points"] = numbers(3 * int(words[1]), ">f8").reshape(-1, 3)
        elif words[:1] == ["POLYGONS"]:
            out["faces"] = numbers(int(words[2]), ">i4").reshape(-1, 4)
        elif words[:1] == ["SCALARS"]:
            line()
            out[words[1]] = numbers(len(out["points"]), ">f8")
        elif words[:1] == ["VECTORS"]:
            out[words[1]] = numbers(3 * len(out["points"]), ">f8").reshape(-1, 3)
    return out


def test_a_mesh_has_points_triangles_scalars_and_a_vector(surfaces, tmp_path):
    first, second = surfaces
    write_surface_vtk(second, tmp_path / "mesh.vtk", point_columns(second, first))
    told = read_vtk(tmp_path / "mesh.vtk")
    np.testing.assert_allclose(told["points"], second.x_world[second.measured])
    assert (told["faces"][:, 0] == 3).all() and told["faces"][:, 1:].max() == 46
    assert len(told["faces"]) == len(second.triangles) == 2 * 7 * 5 - 6
    np.testing.assert_allclose(told["displacement"][:, 0], told["dx_m"])
    np.testing.assert_allclose(told["dx_m"], 0.01 * told["points"][:, 0] / 1.01, atol=1e-12)


def test_a_picture_has_a_scale_and_refuses_nothing(surfaces, tmp_path):
    first, _ = surfaces
    image = np.random.default_rng(0).uniform(0, 255, (60, 80)).astype(np.float32)
    values = first.x_world[:, 0]
    write_field_picture(first, image, values, tmp_path / "field.png", title="x", unit="m")
    picture = cv2.imread(str(tmp_path / "field.png"))
    assert picture.shape == (60, 80 + 180, 3)
    with pytest.raises(ExportError, match="no measurement to show"):
        write_field_picture(first, image, np.full(48, np.nan), tmp_path / "none.png", title="x", unit="m")
    write_point_picture(first.uv[:, 0], image, tmp_path / "points.png")
    assert cv2.imread(str(tmp_path / "points.png")).shape == (60, 80, 3)


def test_paths_are_rows_of_times_and_points(tmp_path):
    x = np.zeros((4, 3, 3))
    x[:, :, 0] = 0.1 * np.arange(4)[:, None]
    x[2:, 1] = np.nan
    paths = Trajectories(np.arange(4) / 10, x, np.full_like(x, 1e-3), np.zeros((4, 3, 2, 2)))
    write_paths_csv(paths, tmp_path / "paths.csv")
    with (tmp_path / "paths.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    assert float(rows[4]["vx"]) == pytest.approx(1.0) and rows[4]["vy"] == "0" and rows[0]["ax"] == ""
