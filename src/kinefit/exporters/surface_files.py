"""Measured surfaces as tables (CSV), meshes (VTK, for ParaView) and pictures with a scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import write_bytes, write_image, write_rows
from kinefit.errors import ExportError
from kinefit.images.photogrammetry.returning import PointReturn
from kinefit.images.photogrammetry.strain import Strain
from kinefit.images.photogrammetry.surface import MeasuredSurface, displacement_std
from kinefit.images.photogrammetry.trajectories import Trajectories

_MAX_IMAGE_SIDE_PX = 1400  # [px] of a picture's longer side
_BAR = 90  # [px] of the scale beside it
_MAX_PATHS = 200  # in a picture
_ARROW_PX = 30.0  # [px] of the 95th percentile of a vector field's arrows


def point_columns(
    surface: MeasuredSurface, reference: MeasuredSurface | None = None, strain: Strain | None = None, window: int = 0
) -> dict[str, NDArray]:
    """Named columns (N,) of all points: places [m], standard deviations [m], quality, displacement [m] and strain.

    `window`: [px] side of the matching windows, for the displacement's standard deviations.
    """
    out = {}
    for axis, name in enumerate("xyz"):
        out[f"std_{name}_m"] = surface.std[:, axis]
    out["correlation"], out["parallax_px"] = surface.correlation, surface.parallax
    if reference is not None:
        moved = surface.x_world - reference.x_world
        std = displacement_std(reference, surface, window)
        out |= {f"d{name}_m": moved[:, axis] for axis, name in enumerate("xyz")}
        out |= {f"std_d{name}_m": std[:, axis] for axis, name in enumerate("xyz")}
    if strain is not None:
        out |= {f"strain_{name}": getattr(strain, name) for name in ("xx", "yy", "xy", "first", "second")}
        out |= {f"std_strain_{name}": getattr(strain, f"std_{name}") for name in ("xx", "yy", "xy")}
        out["strain_angle_rad"] = strain.angle
    return out


def write_points_csv(surface: MeasuredSurface, path: str | PathLike[str], columns: Mapping[str, NDArray]) -> None:
    """Write the measured points: row and column of the grid, pixels in the first camera, metres, and more columns.

    Raises
    ------
    ExportError
        Where it cannot be written.
    """
    index = np.flatnonzero(surface.measured)
    row, column = np.divmod(index, surface.grid.columns)
    more = [value[index] for value in columns.values()]
    table = np.column_stack([surface.uv[index, 0], surface.x_world[index], *more])
    head = ["row", "column", "u_px", "v_px", "x_m", "y_m", "z_m", *columns]
    write_rows(path, [head, *([r, c, *_cells(values, ".9g")] for r, c, values in zip(row, column, table))])


def write_surface_vtk(surface: MeasuredSurface, path: str | PathLike[str], columns: Mapping[str, NDArray]) -> None:
    """Write the mesh with a scalar for each column, in the legacy VTK format that ParaView opens; metres.

    Displacements dx_m, dy_m, dz_m become a vector as well. Errors as of `write_points_csv`.
    """
    index = np.flatnonzero(surface.measured)
    place = np.full(len(surface.x_world), -1)
    place[index] = np.arange(len(index))
    faces = place[surface.triangles]
    parts = [b"# vtk DataFile Version 3.0\nkinefit surface, metres\nBINARY\nDATASET POLYDATA\n"]
    parts += [f"POINTS {len(index)} double\n".encode(), surface.x_world[index].astype(">f8").tobytes()]
    cells = np.column_stack([np.full(len(faces), 3), faces]).astype(">i4")
    parts += [f"\nPOLYGONS {len(faces)} {cells.size}\n".encode(), cells.tobytes()]
    parts += [f"\nPOINT_DATA {len(index)}\n".encode()]
    for name, value in columns.items():
        parts += [f"SCALARS {name} double 1\nLOOKUP_TABLE default\n".encode()]
        parts += [value[index].astype(">f8").tobytes(), b"\n"]
    if "dx_m" in columns:
        moved = np.column_stack([columns[f"d{axis}_m"][index] for axis in "xyz"]).astype(">f8")
        parts += [b"VECTORS displacement double\n", moved.tobytes(), b"\n"]
    write_bytes(path, b"".join(parts))


def write_field_picture(
    surface: MeasuredSurface, image: NDArray, values: NDArray, path: str | PathLike[str], *, title: str, unit: str
) -> None:
    """Paint a field over the first camera's image of the state, with a scale: PNG.

    Parameters
    ----------
    image : (H, W) grey values of the first camera
    values : (N,), one for each point; the scale runs from their 1st to their 99th percentile
    title, unit : written next to the scale
    """
    shown = surface.measured & np.isfinite(values)
    if not shown.any():
        raise ExportError("no measurement to show", file=path, remedy="Look at the correlations in the CSV file.")
    picture, scale = _backdrop(image)
    codes, bottom, top = _coloured(values, shown)
    painted = picture.copy()
    uv = (surface.uv[:, 0] + 0.5) * scale - 0.5
    for triangle in surface.triangles:
        if shown[triangle].all():
            colour = tuple(int(c) for c in codes[triangle].mean(axis=0))
            cv2.fillConvexPoly(painted, np.rint(uv[triangle] * 8).astype(np.int32), colour, shift=3)
    picture = cv2.addWeighted(painted, 0.75, picture, 0.25, 0)
    write_image(path, np.hstack([picture, _scale(picture.shape[0], bottom, top, title, unit)]))


def write_paths_picture(paths: Trajectories, view: int, image: NDArray, path: str | PathLike[str]) -> None:
    """Draw paths over a camera's image, from dark (first frame) to bright (last one): PNG (P4 fig. 8).

    Parameters
    ----------
    paths : with at least one point; of many, the `_MAX_PATHS` that exist in most frames are drawn
    view : index of the camera
    image : (H, W) grey values of that camera
    """
    picture, scale = _backdrop(image)
    codes, first, last = _coloured(paths.times, np.ones(len(paths.times), bool))
    longest = np.argsort(-paths.live.sum(axis=0), kind="stable")[:_MAX_PATHS]
    uv = (paths.uv[:, longest, view] + 0.5) * scale - 0.5
    for k in range(len(uv) - 1):
        ways = np.stack([uv[k], uv[k + 1]], axis=1)
        ways = np.rint(8 * ways[np.isfinite(ways).all(axis=(1, 2))]).astype(np.int32)
        cv2.polylines(picture, list(ways), False, codes[k].tolist(), 2, cv2.LINE_AA, 3)
    write_image(path, np.hstack([picture, _scale(len(picture), first, last, "time", "s")]))


def write_velocity_picture(paths: Trajectories, frame: int, image: NDArray, path: str | PathLike[str]) -> bool:
    """Draw the vector field of a frame over the first camera's image, coloured by speed: PNG (P4 fig. 9).

    Arrows follow the points' motion in the image, the 95th percentile `_ARROW_PX` long. Returns whether a point moves.

    Parameters
    ----------
    frame : index of the frame, neither the first nor the last
    image : (H, W) grey values of the first camera in that frame
    """
    picture, scale = _backdrop(image)
    uv, flow = paths.uv[frame, :, 0], paths.uv[frame + 1, :, 0] - paths.uv[frame - 1, :, 0]
    shown, length = np.isfinite(flow + uv).all(axis=1), np.linalg.norm(flow, axis=1)
    if not length[shown].any():
        return False
    codes, bottom, top = _coloured(np.linalg.norm(paths.velocity[frame], axis=1), shown)
    starts = (uv + 0.5) * scale - 0.5
    tips = starts + _ARROW_PX / np.percentile(length[shown], 95) * flow
    for p in np.flatnonzero(shown):
        start, tip = (tuple(np.rint(8 * at[p]).astype(int).tolist()) for at in (starts, tips))
        cv2.arrowedLine(picture, start, tip, codes[p].tolist(), 1, cv2.LINE_AA, 3, 0.3)
    write_image(path, np.hstack([picture, _scale(len(picture), bottom, top, "speed", "m/s")]))
    return True


def _backdrop(image: NDArray) -> tuple[NDArray, float]:
    """An image (H, W) in grey as (h, w, 3), at most `_MAX_IMAGE_SIDE_PX` wide or high, and its scale."""
    scale = min(1.0, _MAX_IMAGE_SIDE_PX / max(image.shape))
    low, high = np.percentile(image, (0.5, 99.5))
    grey = np.clip((image - low) * (255.0 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), scale


def _coloured(values: NDArray, shown: NDArray) -> tuple[NDArray, float, float]:
    """Colours (N, 3) of values (N,), and the 1st and 99th percentile of those shown (N,) bool, where colours end."""
    bottom, top = np.percentile(values[shown], (1, 99)).tolist()
    level = np.where(shown, np.clip((values - bottom) / max(top - bottom, 1e-12), 0, 1), 0.0)
    return cv2.applyColorMap((255 * level).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)[:, 0], bottom, top


def write_paths_csv(paths: Trajectories, path: str | PathLike[str]) -> None:
    """Write a row for each point and time: metres, seconds, m/s and m/s². Errors as of `write_points_csv`."""
    velocity, acceleration = paths.velocity, paths.acceleration
    names = [*"xyz", *(f"std_{a}" for a in "xyz"), *(f"v{a}" for a in "xyz"), *(f"a{a}" for a in "xyz")]
    rows: list[list[object]] = [["time_s", "point", *names]]
    for k, time in enumerate(paths.times):
        index = np.flatnonzero(paths.live[k])
        table = np.hstack([paths.x_world[k, index], paths.std[k, index], velocity[k, index], acceleration[k, index]])
        rows += [[f"{time:.6f}", p, *_cells(values, ".6g")] for p, values in zip(index, table)]
    write_rows(path, rows)


def write_returns_csv(returns: Sequence[PointReturn], rate: float, path: str | PathLike[str]) -> None:
    """Write a row for each point that vanished: when it was lost, is expected and was found [s]; empty for never."""
    frames = np.array([[of.lost, of.expected, of.found] for of in returns], float).reshape(-1, 3)  # NaN for None
    rows = [[of.point, *_cells(times, ".6f")] for of, times in zip(returns, frames / rate)]
    write_rows(path, [["point", "lost_s", "expected_s", "found_s"], *rows])


def write_point_picture(uv: NDArray, image: NDArray, path: str | PathLike[str]) -> None:
    """Draw points (M, 2) [px] on an image (H, W): PNG."""
    picture = cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    for place in np.rint(uv * 8).astype(int):
        cv2.circle(picture, (int(place[0]), int(place[1])), 12, (0, 200, 255), -1, cv2.LINE_AA, 3)
    write_image(path, picture)


def _cells(values: NDArray, form: str) -> list[str]:
    """Numbers as CSV has them, nothing for what is not finite."""
    return [f"{v:{form}}" if np.isfinite(v) else "" for v in values.tolist()]


def _scale(height: int, bottom: float, top: float, title: str, unit: str) -> NDArray:
    """A bar of colours (height, 2 * _BAR, 3) with its ends and its middle."""
    out = np.full((height, 2 * _BAR, 3), 255, np.uint8)
    first, last = min(50, height // 3), height - min(20, height // 5)
    ramp = np.linspace(255, 0, last - first).astype(np.uint8).reshape(-1, 1)
    out[first:last, 10:30] = cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)
    for text, y in ((title, 18), (f"[{unit}]", 38)):
        cv2.putText(out, text, (8, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = int(last - 1 - share * (last - first - 1))
        cv2.putText(
            out, f"{bottom + share * (top - bottom):.4g}", (36, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return out
