"""What the Python blocks of each page take for granted: names and files, made anew for every page.

A page's function is a generator: it yields the names that its next block needs, and is sent all names after that block.
"""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
from tests.docs import drawn
from tests.docs.world import world
from tests.fitting.subject.measured import pixels

import kinefit
from kinefit.bodies import load_body
from kinefit.bodies.morphs.morphing import Morphing
from kinefit.bodies.parts import free_parts, parts_state
from kinefit.exporters import write_markers, write_motion
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, KeypointFrame, PointCloud
from kinefit.simulation import simulate_keypoints


def anny(folder):
    w = world()
    space = yield {"rig": w.rig}
    model = space["model"]
    body = model.body(model.of_stature(1.8))
    states = [body.default_state()] * 2
    assert load_body("person.npz").skin is not None
    space = yield {"rig": w.rig, "steps": pixels(body, states, w.rig), "states": states}
    assert space["found"].value("anny gender")[1] > 0.0


def batch(folder):
    for name in ("monday", "tuesday"):
        drawn.write_take(folder / "sessions" / name)
    yield {}


def calibration(folder):
    drawn.board_videos(folder / "videos")
    yield {}
    drawn.bar_videos(folder / "videos")
    yield {}


def check(folder):
    drawn.write_take(folder)
    yield {}


def depth_start(folder):
    w = world()
    yield {"body": w.body, "camera": w.depth_camera, "depth": w.depth.frame(0).depth}


def files(folder):
    (folder / "take-kinefit").mkdir()
    write_motion(world().motion, folder / "take-kinefit" / "motion.npz")
    yield {}
    (folder / "depth").mkdir()
    image = np.full((480, 640), 1.4)
    image[100:400, 250:400] = 1.0  # somebody before a wall
    cv2.imwrite(str(folder / "depth" / "0.png"), (image / 0.000125).astype(np.uint16))
    yield {}


def live(folder):
    drawn.write_take(folder)
    yield {}
    yield {}


def marker_fitting(folder):
    w = world()
    write_markers(w.markers(20), folder / "static.trc")
    write_markers(w.markers(40), folder / "run.trc")
    yield {}
    yield {"markers": drawn.markers_of_leg()}


def markers(folder):
    w = world()
    write_markers(w.markers(), folder / "labelled.c3d")
    plain = w.markers(40)
    write_markers(replace(plain, names=tuple(f"*{i}" for i in range(len(plain.names)))), folder / "points.c3d")
    yield {}
    stream = [(float(t), x[np.isfinite(x).all(axis=1)]) for t, x in zip(np.arange(3) / 60.0, plain.positions)]
    yield {"rig": Rig(()), "stream": stream}


def morphing(folder):
    body, skinned = load_body("arm"), Morphing(load_body("humanoid_morphing"))
    man = skinned.body
    target = np.array(skinned.mesh.vertices) * (1.0, 1.0, 1.1)
    yield {"man": man, "target": target, "local_morphs": (), "arm": body}
    yield {"state": man.default_state(), "nodes": np.arange(3), "directions": np.tile((0.0, 1.0, 0.0), (3, 1))}


def motion(folder):
    yield {"motion": world().motion, "f": 3}


def own_sensor(folder):
    w = world()
    yield {}
    keypoints = w.seen(0)[0]
    space = yield {"body": w.body, "rig": w.rig, "keypoints": keypoints, "time": keypoints.time}
    load = [space["Pressure"](float(t), (300.0, 120.0)) for t in w.motion.times]
    yield {"steps": [[*w.seen(i), load[i]] for i in range(w.frames)]}
    yield {}


def depth_fusion(folder):
    w = world()
    rig = Rig((w.depth_camera, replace(w.colour, name="colour")))
    k = simulate_keypoints(w.motion, Rig((rig["colour"],)), "BODY_25B")[0]
    seen = []
    for i, t in enumerate(w.motion.times[:2]):
        frame = KeypointFrame("colour", float(t), k.names, k.points[i, 0], k.confidence[i, 0], k.keypoint_set)
        seen.append((float(t), w.depth.frame(i).depth, frame))
    yield {"body": w.body, "rig": rig, "stream": seen}
    steps = [[DepthFrame("kinect", t, depth), keypoints] for t, depth, keypoints in seen]
    yield {"kinefit": kinefit, "steps": steps}


def printed_regions(folder):
    from tests.sensors import region_scenes as scenes

    start, true = scenes.state((0.006, 0.0, 0.0), (0.0, 0.1, 0.0)), scenes.state()
    image = scenes.image(true)
    given = {"body": scenes.thing(), "rig": scenes.RIG, "state": start}
    space = yield {**given, "image": image, "images": [{"cam": image}]}
    assert np.linalg.norm(space["fit"].state.T_world_root[:3, 3] - true.T_world_root[:3, 3]) < 0.01


def printed_metaballs(folder):
    body = load_body("arm_metaballs")
    states = [body.rest_state()]
    yield {"points": [drawn.skin_points(body, states[0], 600)], "states": states}


def regions(folder):
    from tests.sensors import region_scenes as scenes

    state = scenes.state()
    depth = drawn.depth_of(scenes.thing(), state, scenes.CAMERA)
    given = {"body": scenes.thing(), "rig": scenes.RIG, "state": state, "time": 0.0, "image": scenes.image(state)}
    space = yield given
    assert space["result"].quality > 0.5
    yield {**given, "depth": depth}


def report(folder):
    write_motion(world().motion, folder / "motion.npz")
    yield {}


def rows(folder):
    yield {"segment": [0], "point": [[0.0, 1.0, 0.0]], "direction": [[0.0, 1.0, 0.0]], "residual": [0.01],
           "weight": 1e4}  # fmt: skip


def sapm(folder):
    model = kinefit.learn_model(world().markers(), name="anna")
    yield {"model": model, "points": world().markers(1).positions[0]}


def silhouettes(folder):
    w = world()
    turn = 2 * np.pi * np.arange(48) / 48
    away = 0.12 + 0.02 * np.cos(2 * turn) + 0.015 * np.sin(3 * turn)
    points = np.stack([away * np.cos(turn), away * np.sin(turn), 0.04 * np.sin(2 * turn)], axis=1)
    camera, truth, mask = drawn.ring(points)
    space = yield {"points": points, "T_world_object": drawn.nudged(truth), "camera": camera, "mask": mask}
    assert space["fit"].error < 1.0
    frames, states = drawn.masks(w, (0, 6))
    rig = w.rig
    yield {"body": w.body, "rig": rig, "frames": frames, "states": states}
    empty = np.full((*rig["cam01"].size[::-1], 3), 90, np.uint8)
    image = empty.copy()
    image[frames[0][0].mask] = (200, 150, 100)
    space = {"body": w.body, "rig": rig, "state": states[0], "empty": empty, "image": image, "time": 0.0}
    yield space


def simulate(folder):
    w = world()
    yield {"motion": w.motion}
    yield {"body": w.body, "state": w.motion.state(0), "camera": w.depth_camera}


def smoothing(folder):
    drawn.write_take(folder)
    yield {}
    assert not (folder / "unfinished").exists()
    w = world()
    yield {"tracker": kinefit.Tracker(w.body, w.rig, rate=w.motion.rate, up=w.up), "stream": w.steps}


def solvers(folder):
    w = world()
    states = [w.motion.state(i) for i in (0, 4, 8)]
    yield {"body": w.body, "rig": w.rig, "steps": pixels(w.body, states, w.rig), "states": states}


def stereo(folder):
    rig, left, right = drawn.stereo_pair()
    space = yield {"rig": rig, "left_image": left, "right_image": right, "time": 0.0}
    assert np.isfinite(space["frame"].depth).any()
    body = load_body("humanoid")
    yield {"body": body, "state": body.default_state()}


def surfaces(folder):
    before, after = drawn.speckles((600, 800))
    space = yield {"before": before, "after": after}
    assert np.nanmedian(np.abs(space["found"].uv - space["grid"].points)) < 3.0
    w = world()
    ids, x = np.arange(4), w.motion.positions()[0, :4]
    tracked = SimpleNamespace(ids=ids, x_world=x, covariance=np.tile(1e-6 * np.eye(3), (4, 1, 1)))
    tracker = SimpleNamespace(update=lambda images: tracked)
    yield {"kinefit": kinefit, "body": w.body, "rig": w.rig, "surface_tracker": tracker, "images": {}, "time": 0.0,
           "others": w.seen(0)}  # fmt: skip
    body = load_body("arm_metaballs")
    x = drawn.skin_points(body, body.rest_state(), 3000)
    yield {"x": x}


def view(folder):
    w = world()
    frames = [(float(t), w.motion.state(i), {}) for i, t in enumerate(w.motion.times[:3])]
    yield {"body": w.body, "rig": w.rig, "frames": frames}


def voodoo(folder):
    w = world()
    body = load_body("humanoid10")
    start = body.default_state()
    x = drawn.skin_points(body, start)
    stream = [[PointCloud("tof", 0.0, x)]]
    yield {"stream": stream, "body": body, "start": start, "rig": Rig((w.depth_camera,))}
    frames, _ = body.tree.forward(start.T_world_root, start.angles)
    yield {"points": x, "state": parts_state(free_parts(body), frames)}


PREPARED = {
    "anny": anny, "batch": batch, "calibration": calibration, "check": check, "depth-start": depth_start,
    "files": files, "live": live, "marker-fitting": marker_fitting, "markers": markers, "morphing": morphing,
    "motion": motion, "own-sensor": own_sensor, "depth": depth_fusion,
    "printed-metaballs": printed_metaballs, "printed-regions": printed_regions, "regions": regions,
    "report": report, "rows": rows, "printed-sapm": sapm, "silhouettes": silhouettes, "simulate": simulate,
    "smoothing": smoothing, "solvers": solvers, "stereo": stereo, "surfaces": surfaces,
    "view": view,
    "printed-voodoo": voodoo,
}  # fmt: skip
"""{page: its function}."""

AFTER = {"live": ("follow('take.toml')",)}
"""{page: code that calls what its blocks define}."""

NETWORK = {"anny"}
"""Pages whose blocks fetch a pinned package."""

SLOW = {"anny", "batch", "calibration", "depth", "silhouettes"}
"""Pages that take more than a few seconds."""
