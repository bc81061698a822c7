"""Read `[skin]` of a body file: one mesh over all segments, with weights."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit.bodies.surfaces.obj import MAX_LENGTH, UNITS, read_obj
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, located


class SkinRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[skin]`: an OBJ file in the root's frame at rest, and a CSV file of weights, relative to the body file."""

    mesh: str
    weights: str
    unit: str = "m"
    owners: Annotated[int, msgspec.Meta(ge=1)] = 4


def skin_of(record: SkinRecord | None, tree: KinematicTree, source: str) -> SkinnedMesh | None:
    """Read the skin of a body file; `source` is the body file. None without a record.

    Raises
    ------
    BodyError
        Files that cannot be read, an unknown unit, segment or vertex, a duplicate weight; a mesh with holes or flipped
        faces, weights that do not sum to one (see `SkinnedMesh`).
    """
    if record is None:
        return None
    mesh, table = (Path(source).parent / name for name in (record.mesh, record.weights))
    with located(source, "skin"):
        check_choice("unit", record.unit, UNITS, BodyError, remedy="Use one of these.")
        vertices, faces = read_obj(mesh)
        vertices = UNITS[record.unit] * vertices
        if (size := float(np.ptp(vertices, axis=0).max())) > MAX_LENGTH:
            remedy = 'State the unit of its file, such as unit = "mm".'
            raise BodyError(f"the skin is {size:.4g} m long", file=mesh, remedy=remedy)
        weights = read_weights(table, len(vertices), tree)
        try:
            return SkinnedMesh.of(vertices, faces, weights, tree, owners=record.owners)
        except BodyError as error:
            file = table if "weights" in error.problem else mesh
            raise BodyError(error.problem, file=file, remedy=error.remedy) from error


def read_weights(path: Path, count: int, tree: KinematicTree) -> NDArray:
    """Read weights (V, S) from a CSV file: lines of vertex (counted from 1, as in OBJ files), segment, weight.

    Without a weight the segment owns the vertex alone, as in P1's joint list. A header line is skipped.

    Raises
    ------
    BodyError
        A file that cannot be read, an invalid line, an unknown segment or vertex, a duplicate weight.
    """
    try:
        lines = list(csv.reader(regular(path).read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, ValueError, csv.Error) as error:
        remedy = "Give the path of a CSV file with lines of vertex, segment, weight."
        problem = f"cannot read the weights ({getattr(error, 'strerror', None) or error})"
        raise BodyError(problem, file=path, remedy=remedy) from error
    out = np.full((count, len(tree.segments)), np.nan)
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line]
        if not any(cells) or (number == 1 and not cells[0].isdigit()):
            continue
        with located(path, f"line {number}"):
            try:
                vertex, segment = int(cells[0]), cells[1]
                weight = float(cells[2]) if len(cells) > 2 and cells[2] else 1.0
            except (ValueError, IndexError) as error:
                remedy = "A line has a vertex counted from 1, a segment, and a weight."
                raise BodyError(f"not a weight: '{','.join(line)[:60]}'", remedy=remedy) from error
            check_choice("segment", segment, tree.segments, BodyError, remedy="Use one of these.")
            s, known = tree.segments.index(segment), 1 <= vertex <= count
            if not known or not np.isnan(out[vertex - 1, s]):
                problem = f"vertex {vertex} of {count} " + ("twice" if known else "is not there")
                raise BodyError(problem, remedy="Give each of the mesh's vertices, from 1, once.")
        out[vertex - 1, s] = weight
    return np.nan_to_num(out, nan=0.0)
