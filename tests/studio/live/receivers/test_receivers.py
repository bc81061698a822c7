"""Poses as other programs read them: WebSocket clients, python-osc, pylsl, JSON lines, a motion file."""

import json
import queue
import re
import socket
import time
from dataclasses import replace
from urllib.request import urlopen

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from kinefit.bodies.motion import rotation_between_up
from kinefit.errors import ExportError
from kinefit.geometry import se3
from kinefit.readers.motion import read_motion
from kinefit.studio.live.receivers.websocket import BONES, JsonLines, Vmc, WebSockets
from kinefit.studio.live.record import MotionRecord
from kinefit.studio.live.session import LiveSession


@pytest.fixture
def played(scene, collected):
    """A session that is over, with all its poses."""
    LiveSession(scene.tracker(), [scene.replay()], [collected]).run()
    return collected


def at(server):
    """Of poses and requests, with the token."""
    return server.url.replace("http", "ws", 1)


@pytest.fixture
def served(scene, played):
    server = WebSockets(0, title="trial <1>")
    server.hello(scene.motion.body, played.hellos[0])
    yield server
    server.close()


def test_a_client_gets_the_body_and_then_poses(served, played):
    with connect(at(served)) as client:
        assert client.recv(5.0) == played.hellos[0].decode()
        served.pose(played.poses[0], played.packets[0])
        assert client.recv(5.0) == played.packets[0].decode()


def test_a_slow_client_misses_poses_and_the_others_miss_none(served, played):
    url = at(served)
    with connect(url, max_queue=1) as slow, connect(url) as quick:
        quick.recv(5.0)
        many = b'{"type":"pose","fill":"' + b"x" * 200_000 + b'","number":%d}'
        begin = time.monotonic()
        for k in range(300):
            served.pose(played.poses[0], many % k)
            assert json.loads(quick.recv(5.0))["number"] == k
        assert time.monotonic() - begin < 60.0
        slow.recv(5.0)
        served.pose(played.poses[0], many % 300)
        got, last = 0, -1
        while last < 300:
            last, got = json.loads(slow.recv(5.0))["number"], got + 1
        assert got < 300


def test_wishes_are_passed_on_and_answered(scene, played):
    asked = queue.Queue()
    server = WebSockets(0, ask=lambda *request: asked.put(request))
    try:
        server.hello(scene.motion.body, played.hellos[0])
        with connect(at(server)) as client:
            client.recv(5.0)
            client.send('{"stop": true}')
            request, answer = asked.get(timeout=5.0)
            assert request == b'{"stop": true}'
            answer({"type": "done"})
            assert json.loads(client.recv(5.0)) == {"type": "done"}
    finally:
        server.close()
    answer({"type": "done"})  # nobody is there any more


def test_without_the_token_poses_are_read_and_no_wish_is_heard(scene, played):
    server = WebSockets(0, ask=lambda *request: pytest.fail(f"{request} was heard"))
    try:
        server.hello(scene.motion.body, played.hellos[0])
        with connect(f"ws://127.0.0.1:{server.port}") as client:
            assert client.recv(5.0) == played.hellos[0].decode()
            client.send('{"stop": true}')
            answer = json.loads(client.recv(5.0))
            assert answer["type"] == "refused" and "need the token" in answer["why"]
        for address in (f"ws://127.0.0.1:{server.port}/{'x' * 24}", at(server)):
            with pytest.raises(InvalidStatus, match="403"):
                connect(address, origin="https://evil.example")
    finally:
        server.close()


def test_who_floods_a_session_is_cut_off_and_others_get_every_pose(scene, collected):
    """Each pose waits for the quiet client's last, so that it counts what it gets and no clock decides."""
    session = LiveSession(scene.tracker(), [scene.replay()], [collected])
    server = WebSockets(0, ask=session.ask)
    got = []

    class Quiet:
        def hello(self, body, packet):
            self.client = connect(at(server))
            self.client.recv(10.0)

        def pose(self, posed, packet):
            got.append(self.client.recv(10.0) == packet.decode())

        def close(self):
            self.client.close()

    class Flood(Quiet):
        def hello(self, body, packet):
            super().hello(body, packet)
            with pytest.raises(ConnectionClosed):
                for _ in range(5000):
                    self.client.send('{"sensor": "cam01", "sigma": 1e-300}')
                while True:
                    self.client.recv(10.0)

        def pose(self, posed, packet):
            pass

    session.receivers = (server, collected, Quiet(), Flood())
    session.run()
    server.close()
    assert session.found == len(scene.recording) and got == [True] * len(scene.recording)


def test_answers_that_nobody_reads_end_the_connection(scene, played):
    """A client that takes nothing in: what waits for it does not grow for ever."""
    server = WebSockets(0, ask=lambda request, answer: [answer({"fill": "x" * 100_000}) for _ in range(300)])
    try:
        server.hello(scene.motion.body, played.hellos[0])
        with connect(at(server), max_queue=1) as client:
            client.recv(5.0)
            assert server.receivers == 1
            client.send('{"stop": true}')
            for _ in range(1000):
                if server.receivers:
                    time.sleep(0.01)
            assert not server.receivers
    finally:
        server.close()


def test_the_page_has_the_body_and_escapes_the_name(served):
    html = urlopen(served.url).read().decode()
    assert "<h1>trial &lt;1&gt;</h1>" in html and 'class="player"' in html and "WebSocket" in html
    assert " style=" not in html and not re.search(r"<[^>]* on\w+=", html)
    with pytest.raises(OSError, match="404"):
        urlopen(f"{served.url}etc/passwd")


def test_a_port_in_use_is_told(served):
    with pytest.raises(ExportError, match=f"127.0.0.1:{served.port}"):
        WebSockets(served.port)


def test_avatars_get_the_same_pose_by_osc(scene, played):
    """Read by python-osc; joint centres recomputed from local poses in Unity's world agree within 1e-5 m."""
    from pythonosc.osc_bundle import OscBundle

    posed, body = played.poses[-1], scene.motion.body
    vmc = Vmc("127.0.0.1", 39539, up=scene.motion.up)
    vmc.hello(body, b"")
    bones = {}
    for data in vmc.packets(posed.Ts_world_segment, posed.time):
        assert len(data) <= 1500
        for message in OscBundle(data):
            if message.address == "/VMC/Ext/Bone/Pos":
                name, *numbers = message.params
                bones[name] = np.array(numbers)
    vmc.close()
    assert {"Hips", "Chest", "Head", "LeftLowerArm", "RightFoot"} <= set(bones)
    tree = body.tree
    above = {BONES[n]: BONES[tree.segments[tree.parents[s]]] for s, n in enumerate(tree.segments) if s and n in BONES}
    world = {}
    for name in (BONES[n] for n in tree.segments if n in BONES):
        x, y, z, qx, qy, qz, qw = bones[name]
        T = se3.transform(se3.rotation_from_quaternion(np.array([qw, qx, qy, qz])), np.array([x, y, z]))
        world[name] = world[above[name]] @ T if name in above else T
    turn = rotation_between_up(scene.motion.up, "y")
    for s, n in enumerate(tree.segments):
        if n in BONES:
            expected = turn @ posed.Ts_world_segment[s, :3, 3] * (-1.0, 1.0, 1.0)
            assert np.allclose(world[BONES[n]][:3, 3], expected, atol=1e-5)


def test_fingers_are_those_of_the_avatar():
    from kinefit.bodies import load_body

    tree = load_body("humanoid_hands").tree
    named = {BONES[s] for s in tree.segments if s.endswith("_l") and s not in load_body("humanoid").tree.segments}
    assert named == {f"Left{f}{k}" for f in ("Thumb", "Index", "Middle", "Ring", "Little")
                     for k in ("Proximal", "Intermediate", "Distal")}  # fmt: skip


def test_jaw_and_eyes_are_those_of_the_avatar():
    assert {s: BONES[s] for s in ("jaw", "eye_l", "eye_r")} == {"jaw": "Jaw", "eye_l": "LeftEye", "eye_r": "RightEye"}


def test_an_avatar_at_rest_stands_as_a_t():
    """A body in T pose that faces z has no turn in any bone: Unity's humanoid at rest."""
    from kinefit.bodies import load_body
    from kinefit.exporters.skeletons.common import rest_pose

    body = load_body("humanoid")
    vmc = Vmc("127.0.0.1", 39539, up="y")
    vmc.hello(body, b"")
    Ts = np.tile(np.eye(4), (len(body.tree.segments), 1, 1))
    pose = rest_pose(body, "t", "kinefit", "test")
    Ts[:, :3, :3], Ts[:, :3, 3] = pose.turns, pose.positions
    from pythonosc.osc_bundle import OscBundle

    sent = [m for data in vmc.packets(Ts, 0.0) for m in OscBundle(data) if "Bone" in m.address]
    told = {m.params[0]: np.array(m.params[1:]) for m in sent}
    vmc.close()
    assert all(np.allclose(v[3:], [0, 0, 0, 1], atol=1e-6) for v in told.values())
    assert told["LeftLowerArm"][0] < -0.2 < 0.2 < told["RightLowerArm"][0]  # x to the right


def test_packets_arrive_by_udp(scene, played):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5.0)
        vmc = Vmc("127.0.0.1", listener.getsockname()[1], up=scene.motion.up)
        vmc.hello(scene.motion.body, b"")
        vmc.pose(played.poses[-1], b"")
        assert listener.recv(2000).startswith(b"#bundle\0")
        vmc.close()


def test_an_unknown_host_is_told():
    with pytest.raises(ExportError, match="cannot be found"):
        Vmc("no such host.invalid", 1, up="z")


def test_laboratories_get_angles_and_joints(scene, played):
    pylsl = pytest.importorskip("pylsl")
    from kinefit.studio.live.receivers.websocket import Lsl

    outlet = Lsl("kinefit-test", rate=30.0)
    outlet.hello(scene.motion.body, b"")
    found = pylsl.resolve_byprop("name", "kinefit-test-angles", timeout=5.0)
    if not found:
        pytest.skip("no network on which LSL finds streams")
    inlet = pylsl.StreamInlet(found[0])
    inlet.open_stream(timeout=5.0)
    sent = pylsl.local_clock()
    outlet.pose(replace(played.poses[-1], latency=0.25), b"")
    sample, stamp = inlet.pull_sample(timeout=5.0)
    assert stamp == pytest.approx(sent - 0.25, abs=0.1)  # when it was measured, not when it was sent
    assert inlet.info().nominal_srate() == pylsl.IRREGULAR_RATE  # else readers space samples evenly over dropped steps
    sampling = inlet.info().desc().child("sampling")
    assert (sampling.child_value("step_rate"), sampling.child_value("missing_samples")) == (
        "30", "person not found, or step dropped"
    )  # fmt: skip
    state = played.poses[-1].result.state
    slides = scene.motion.body.tree.prismatic
    assert np.allclose(sample[: len(state.angles)], np.where(slides, 1.0, np.degrees(1.0)) * state.angles)
    channel = inlet.info().desc().child("channels").child("channel")
    assert channel.child_value("label") == scene.motion.body.tree.coordinates[0]
    outlet.close()


def test_lines_are_the_packets(tmp_path, scene, collected):
    LiveSession(scene.tracker(), [scene.replay()], [JsonLines(tmp_path / "out.jsonl"), collected]).run()
    lines = (tmp_path / "out.jsonl").read_bytes().splitlines()
    assert lines[0] == collected.hellos[0] and len(lines) == 1 + len(collected.packets)
    assert [json.loads(line)["number"] for line in lines[1:]] == list(range(len(collected.packets)))


def test_a_file_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(ExportError, match="cannot be written"):
        JsonLines(tmp_path)


def test_the_session_is_left_as_a_motion(tmp_path, scene, collected):
    record = MotionRecord(tmp_path / "out", rate=scene.motion.rate, up=scene.motion.up, name="trial")
    LiveSession(scene.tracker(), [scene.replay()], [record, collected]).run()
    motion = read_motion(record.path)
    assert len(motion) == len(collected.poses) and motion.name == "trial"
    for k, posed in enumerate(collected.poses):
        assert np.array_equal(motion.angles[k], posed.result.state.angles)
        assert np.array_equal(motion.joint_std[k], posed.result.joint_std)
    assert [p.name for p in record.folder.iterdir()] == ["motion.npz"]


def test_steps_that_were_dropped_are_frames_without_tracking(tmp_path, scene, played):
    record = MotionRecord(tmp_path, rate=scene.motion.rate, up=scene.motion.up, name="trial")
    record.hello(scene.motion.body, b"")
    for k in (0, 1, 5, 6):
        record.pose(played.poses[k], b"")
    record.close()
    motion = read_motion(record.path)
    assert len(motion) == 7 and (motion.quality[[2, 3, 4]] == 0).all() and (motion.quality[[0, 1, 5, 6]] > 0).all()
    assert np.isinf(motion.dof_std[3]).all() and np.allclose(np.diff(motion.times), 1 / motion.rate)
    assert np.array_equal(motion.angles[5], played.poses[5].result.state.angles)


def test_a_session_that_found_nobody_leaves_no_motion(tmp_path):
    record = MotionRecord(tmp_path, rate=30.0, up="z", name="trial")
    record.close()
    assert record.path is None and not list(tmp_path.iterdir())
