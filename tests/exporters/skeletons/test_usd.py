"""USD: what the skin does, what the stage says, and what is refused. Joint positions: test_options.py."""

import builtins

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body, parse_body
from kinefit.errors import ExportError
from kinefit.exporters import write_usd
from kinefit.exporters.skeletons.glb import joint_paths

pxr = pytest.importorskip("pxr")


@pytest.fixture(scope="module", params=[None, "humanoid_face"])
def motion(request):
    return smooth_motion(20, up="z", body=request.param and load_body(request.param))


@pytest.fixture(scope="module")
def stage(motion, tmp_path_factory):
    from pxr import Usd

    path = tmp_path_factory.mktemp("usd") / "a.usdc"
    write_usd(motion, path, up="z")
    return Usd.Stage.Open(str(path))


def skinning(stage):
    from pxr import Usd, UsdSkel

    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    (skinned,) = binding.GetSkinningTargets()
    return cache.GetSkelQuery(binding.GetSkeleton()), skinned


def test_time_and_contents(motion, stage):
    from pxr import UsdGeom

    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, len(motion) - 1)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == motion.rate
    kinds = {prim.GetTypeName() for prim in stage.Traverse()}
    assert kinds == {"SkelRoot", "Skeleton", "SkelAnimation", "Mesh"}
    assert UsdGeom.GetStageUpAxis(stage) == "Z"


def test_the_skin_rests_upright_and_follows_the_joints(motion, stage):
    from pxr import Gf, UsdGeom

    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Figure/Surface"))
    rest = np.array(mesh.GetPointsAttr().Get())
    assert np.argmax(np.ptp(rest, axis=0)) == 2  # z is up
    skeleton, skinned = skinning(stage)
    truth = motion.segment_poses()[..., :3, 3]
    for frame in (0, 11, 19):
        points = mesh.GetPointsAttr().Get()
        assert skinned.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
        at = np.array(points)
        for surface in motion.body.surfaces:
            near = np.linalg.norm(at - truth[frame, surface.segment], axis=1).min()
            assert near < 1.3 * np.max(surface.radii), motion.body.tree.segments[surface.segment]
        low, high = (np.array(v) for v in UsdGeom.Boundable(stage.GetDefaultPrim()).GetExtentAttr().Get(frame))
        assert np.all(at >= low) and np.all(at <= high)
    assert isinstance(skeleton.ComputeJointLocalTransforms(0)[0], Gf.Matrix4d)


def test_joints_are_where_the_motion_has_them(motion, stage):
    skeleton, _ = skinning(stage)
    order = [str(path).rsplit("/", 1)[-1] for path in skeleton.GetJointOrder()]
    columns = [order.index(name) for name in motion.body.tree.segments]
    truth = motion.segment_poses()[..., :3, 3]
    for frame in (0, 7):
        found = np.array([np.array(T)[3, :3] for T in skeleton.ComputeJointSkelTransforms(frame)])[columns]
        assert np.linalg.norm(np.diff(found, axis=0), axis=1) == pytest.approx(
            np.linalg.norm(np.diff(truth[frame], axis=0), axis=1), abs=1e-4
        )


def test_the_checker_of_usd_has_nothing_to_say(stage):
    validation = pytest.importorskip("pxr.UsdValidation")
    registry = validation.ValidationRegistry()
    context = validation.ValidationContext(registry.GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []


def test_names_that_usd_does_not_allow_become_plain_and_stay_different():
    text = """
        body.name = "odd"
        [[segment]]
        name = "1 base"
        joint = { name = "ground", type = "free" }
        [[segment]]
        name = "1:base"
        parent = "1 base"
        joint = { name = "hinge", type = "revolute", axes = ["z"] }
    """
    body = parse_body(text)
    assert joint_paths(body, list(body.tree.segments)) == ["_1_base", "_1_base/_1_base_"]


def test_an_older_file_is_replaced_and_another_ending_refused(motion, tmp_path):
    for _ in range(2):
        write_usd(motion, tmp_path / "a.usda")
    assert [path.name for path in tmp_path.iterdir()] == ["a.usda"]
    with pytest.raises(ExportError, match=r"\.usd, \.usda, \.usdc"):
        write_usd(motion, tmp_path / "a.fbx")
    with pytest.raises(ExportError, match="without frames"):
        write_usd(smooth_motion(0), tmp_path / "b.usda")


def test_a_folder_that_cannot_be_written_is_told(motion, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError):
        write_usd(motion, tmp_path / "file" / "a.usda")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_without_the_package_the_extra_is_named(motion, tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **more):
        if name.split(".")[0] == "pxr":
            raise ImportError(name)
        return real(name, *args, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ExportError, match=r"kinefit\[usd\]"):
        write_usd(motion, tmp_path / "a.usda")
