"""The skin of a person in figures fits the bodies that it is scaled to."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.person_skin import skin

from kinefit.bodies import load_body
from kinefit.bodies.rendering.looks import FILE, body_mesh, person_skin
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh

BODY = load_body("humanoid")


def lies_on(mesh, body, name):
    """(V, 3) [m] vertices that follow one segment alone, in its frame."""
    s = body.tree.segment(name)
    return mesh.vertices[(mesh.segment == s) & (mesh.weights.max(axis=1) > 0.999)] - body.tree.rest[s]


def widened(factor):
    radii = [tuple((factor * a, factor * b) for a, b in c.radii) for c in BODY.surfaces]
    return replace(BODY, surfaces=tuple(replace(c, radii=r) for c, r in zip(BODY.surfaces, radii)))


def test_the_file_is_what_the_benchmark_makes():
    made, every = skin(), []
    with np.load(FILE) as file:
        assert set(file.files) == set(made)
        for name in ("faces", "segments"):
            assert np.array_equal(file[name], made[name])
        np.testing.assert_allclose(file["vertices"], made["vertices"], atol=2e-4)
        for arrays in (file, made):
            every.append(np.zeros((len(made["vertices"]), len(made["segments"]))))
            rows = np.arange(len(every[-1]))[:, None]
            np.add.at(every[-1], (rows, arrays["owners"]), arrays["weights"])
    np.testing.assert_allclose(*every, atol=2e-3)


def test_it_is_one_piece_that_is_as_wide_as_the_cylinders():
    mesh = person_skin(BODY)
    edges = np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)]).tolist()
    assert len(edges) == len(set(map(tuple, edges))) and {(b, a) for a, b in edges} == {(a, b) for a, b in edges}
    assert len(mesh.vertices) - len(edges) / 2 + len(mesh.faces) == 2  # Euler: one closed surface without a handle
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    volume = float(np.sum(a * np.cross(b, c))) / 6
    assert 0.055 < volume < 0.085  # [m3] of a person of 1.74 m
    for c in BODY.surfaces:
        name = BODY.tree.segments[c.segment]
        if name.startswith(("thigh", "shank", "upperarm", "forearm")):
            x = lies_on(mesh, BODY, name)
            radius = np.linalg.norm(x[:, [0, 2]], axis=1).mean()
            assert radius == pytest.approx(np.mean(c.radii), rel=0.15), name


def test_it_is_stretched_with_the_segments_and_widened_with_the_cylinders():
    long = BODY.scaled(np.array([1.2 if group == "thigh" else 1.0 for group in BODY.scale_groups]))
    x, y = lies_on(person_skin(BODY), BODY, "thigh_l"), lies_on(person_skin(long), long, "thigh_l")
    np.testing.assert_allclose(y, 1.2 * x, atol=1e-6)
    x, y = lies_on(person_skin(BODY), BODY, "foot_r"), lies_on(person_skin(long), long, "foot_r")
    np.testing.assert_allclose(y, x, atol=1e-6)
    wide = widened(1.1)
    x, y = lies_on(person_skin(BODY), BODY, "shank_r"), lies_on(person_skin(wide), wide, "shank_r")
    np.testing.assert_allclose(y, x * [1.1, 1.0, 1.1], atol=1e-6)


@pytest.mark.parametrize("name", ["humanoid_hands", "humanoid_shoulders", "cyclist", "snowboarder"])
def test_what_is_no_limb_of_a_person_keeps_its_tubes(name):
    body = load_body(name)
    mesh, tubes = body_mesh(body), body_mesh(body, cylinders=True)
    shared = len(person_skin(body).vertices)
    more = {s for s in range(len(body.tree.segments)) if body.tree.segments[s] not in BODY.tree.segments}
    assert set(mesh.segments[shared:, 0].tolist()) <= more | {-1} or not more
    assert (len(mesh.vertices) > shared) == bool(more & set(tubes.segments[:, 0].tolist()))
    np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0)


@pytest.mark.parametrize("name", ["arm", "humanoid10", "humanoid_metaballs"])
def test_other_bodies_get_none(name):
    assert person_skin(load_body(name)) is None


def test_nor_does_a_body_that_only_has_the_names_of_a_person():
    assert person_skin(widened(4.0)) is None


def test_a_body_that_has_a_skin_keeps_it():
    shape = person_skin(BODY)
    every = np.zeros((len(shape.vertices), len(BODY.tree.segments)))
    np.add.at(every, (np.arange(len(every))[:, None], shape.owners), shape.weights)
    own = SkinnedMesh.of(1.01 * shape.vertices, shape.faces, 0.9 * every + 0.1 / every.shape[1], BODY.tree, owners=6)
    mesh = body_mesh(replace(BODY, skin=own))
    np.testing.assert_allclose(mesh.vertices, own.vertices)
    assert mesh.weights.shape[1] == 4 and own.weights.shape[1] == 6
    np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0)
    assert np.array_equal(mesh.segments[np.arange(len(every)), mesh.weights.argmax(axis=1)], own.segment)
