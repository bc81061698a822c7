"""A session gives what the tracker gives, tells receivers, and does what clients ask for."""

import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from tests.studio.live.refused import REFUSED

from kinefit.bodies.motion import UP_AXES
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.frame.routing import MAX_SIGMA, MIN_SIGMA
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.observations import MarkerFrame
from kinefit.readers.motion import read_motion
from kinefit.studio.live.cameras import Arrived, CameraSource, SessionClock
from kinefit.studio.live.folders import Replay
from kinefit.studio.live.people import LivePerson
from kinefit.studio.live.record import MotionRecord
from kinefit.studio.live.session import LiveSession


def test_a_replay_is_followed_as_the_tracker_follows_it(scene, collected):
    session = LiveSession(scene.tracker(), [scene.replay()], [collected])
    session.run()
    tracker, person = scene.tracker(), LivePerson(scene.rig)
    for step, posed in enumerate(collected.poses):
        records = [k.rows(slice(step, step + 1), float(k.times[step])) for k in scene.keypoints]
        result = tracker.update(person.frames(records, tracker.body, tracker.state), float(scene.recording.times[step]))
        assert np.array_equal(posed.result.state.angles, result.state.angles)
    assert session.processed == len(scene.recording) and collected.closed
    assert not any(session.inbox.dropped.values())


def test_truth_is_found(scene, collected):
    LiveSession(scene.tracker(), [scene.replay()], [collected]).run()
    last = collected.poses[-1]
    centres = scene.motion.segment_poses()[-1, :, :3, 3]
    assert np.linalg.norm(last.Ts_world_segment[:, :3, 3] - centres, axis=1).mean() < 0.02


def test_frames_that_come_too_fast_are_dropped_and_counted(scene, collected):
    session = LiveSession(scene.tracker(), [scene.replay(speed=1000.0)], [collected])
    session.run()
    assert session.processed + session.inbox.dropped["replay"] == len(scene.recording) == session.inbox.came["replay"]
    assert json.loads(collected.packets[-1])["dropped"] == session.inbox.dropped


def test_packets_say_what_the_protocol_says(scene, collected):
    LiveSession(scene.tracker(), [scene.replay()], [collected], name="trial").run()
    hello, pose = json.loads(collected.hellos[0]), json.loads(collected.packets[-1])
    tree = scene.motion.body.tree
    assert hello["type"] == "hello" and hello["name"] == "trial" and hello["segments"] == list(tree.segments)
    assert hello["sensors"] == sorted(scene.rig.names) and hello["up"] == scene.motion.up
    assert pose["type"] == "pose" and len(pose["segments"]) == len(tree.segments)
    assert np.allclose(np.linalg.norm(np.array(pose["segments"])[:, 3:], axis=1), 1.0, atol=1e-4)
    r = collected.poses[-1].result
    assert pose["angle_std"] == [round(s, 6) if np.isfinite(s) else None for s in r.dof_std[6:]]
    assert None in pose["angle_std"]  # fingers that no keypoint shows


def test_what_cannot_be_done_is_refused_and_the_session_goes_on(scene, collected):
    session = LiveSession(scene.tracker(), [scene.replay()], [collected])
    requests = [*REFUSED, ({"sensor": "cam01", "sigma": float("nan")}, "sigma of 'cam01' is nan")]
    answers = [[] for _ in requests]
    for (request, _), told in zip(requests, answers):
        session.ask(request, told.append)
    session.run()
    for (request, why), told in zip(requests, answers):
        assert [a["type"] for a in told] == ["refused"] and why in told[0]["why"], request
    assert session.found == session.processed == len(scene.recording)


def test_sensors_and_weights_change_while_it_runs(scene, collected):
    session, answers = LiveSession(scene.tracker(), [scene.replay()], [collected]), []
    name = scene.rig.names[0]
    session.ask({"sensor": name, "use": False}, answers.append)
    session.ask({"sensor": scene.rig.names[1], "sigma": 30.0}, answers.append)
    session.run()
    assert [a["type"] for a in answers] == ["done", "done"] and answers[0]["asked"] == {"sensor": name, "use": False}
    assert session.tracker.sigma[scene.rig.names[1]] == 30.0
    used = {m.sensor for m in collected.poses[-1].result.measurements}
    assert used and all(len(m.layout.channels.sources) == 3 for m in collected.poses[-1].result.measurements)
    wide = collected.poses[-1].result.joint_std[0].max()
    whole = LiveSession(scene.tracker(), [scene.replay()], [other := type(collected)()])
    whole.run()
    assert wide > 1.2 * other.poses[-1].result.joint_std[0].max()


def test_a_client_can_end_the_session(scene, collected):
    session = LiveSession(scene.tracker(), [scene.replay()], [collected])
    session.ask({"stop": True})
    session.run()
    assert session.processed < len(scene.recording) and collected.closed


@pytest.mark.parametrize("sigma", [MIN_SIGMA, MAX_SIGMA])
def test_no_standard_deviation_that_is_taken_ends_the_session(scene, collected, sigma):
    session, answers = LiveSession(scene.tracker(), [scene.replay()], [collected]), []
    session.ask({"sensor": scene.rig.names[0], "sigma": sigma}, answers.append)
    session.run()
    assert answers[0]["type"] == "done" and session.found == session.processed == len(scene.recording)


def test_one_wish_is_done_a_step_and_those_too_many_are_refused(scene, collected):
    session, answers = LiveSession(scene.tracker(), [scene.replay()], [collected]), []
    for _ in range(100):
        session.ask({"sensor": scene.rig.names[0], "use": True}, answers.append)
    assert len(answers) == 36 and all("64 requests are waiting" in a["why"] for a in answers)
    session.run()
    assert [a["type"] for a in answers[36:]] == ["done"] * len(scene.recording)


def test_a_body_that_a_receiver_cannot_show_is_refused(scene, collected):
    class People(type(collected)):
        def hello(self, body, packet):
            super().hello(body, packet)
            if "pelvis" not in body.tree.segments:
                raise BodyError("no pelvis")

    session, answers = LiveSession(scene.tracker(), [scene.replay()], [people := People()]), []
    session.ask({"body": "arm"}, answers.append)
    session.run()
    assert answers[0]["type"] == "refused" and session.tracker.body.name == scene.motion.body.name
    assert session.found == len(scene.recording)
    assert [json.loads(packet)["body"] for packet in people.hellos] == ["humanoid", "arm", "humanoid"]


def test_a_body_that_what_is_seen_does_not_suit_is_taken_back(scene, collected):
    """Markers of segments that the new body lacks: the session goes on with the body before."""
    body = replace(scene.motion.body, marker_sets={"suit": scene.motion.body.landmarks})
    x = scene.motion.body.trajectories(scene.motion.Ts_world_root, scene.motion.angles, body.landmarks)

    class Suit:
        sensors, patient = ("suit",), True

        def start(self, inbox):
            threading.Thread(target=self.run, args=(inbox,), daemon=True).start()

        def run(self, inbox):
            for t, positions in zip(scene.motion.times, x):
                frame = MarkerFrame("suit", float(t), body.landmarks.names, positions, "suit")
                inbox.put(Arrived("suit", float(t), time.monotonic(), [frame]), wait=True)
            inbox.end("suit")

        def stop(self):
            pass

    tracker = Tracker(body, scene.rig, rate=scene.motion.rate, up=UP_AXES[scene.motion.up])
    session, answers = LiveSession(tracker, [Suit()], [collected]), []
    session.ask({"body": "arm"}, answers.append)
    session.run()
    assert [a["type"] for a in answers] == ["done", "refused"] and "suit" in answers[1]["why"]
    assert session.tracker.body is body and session.found == session.processed == len(x)


def test_a_source_that_fails_ends_the_session_with_its_error(scene, collected):
    stream = CameraSource("cam", (64, 48), SessionClock())
    session = LiveSession(scene.tracker(), [stream], [collected])
    stream._run = lambda inbox: stream._put(inbox, np.zeros((10, 10, 3), np.uint8), 0.0)
    with pytest.raises(ObservationError, match="images have 10x10 px"):
        session.run()
    assert collected.closed


class Asking:
    """A receiver that asks for something after some steps."""

    def __init__(self, requests):
        self.requests, self.count, self.answers = requests, 0, []

    def hello(self, body, packet):
        pass

    def pose(self, posed, packet):
        if self.count in self.requests:
            self.session.ask(self.requests[self.count], self.answers.append)
        self.count += 1

    def close(self):
        pass


def asked(scene, keypoints, requests, *receivers):
    asking = Asking(requests)
    replay = Replay(scene.recording, keypoints, speed=0.0)
    asking.session = LiveSession(scene.tracker(), [replay], [*receivers, asking])
    asking.session.run()
    return asking


def test_a_pause_is_a_gap_in_the_recorded_motion(scene, collected, tmp_path):
    record = MotionRecord(tmp_path, rate=scene.motion.rate, up=scene.motion.up, name="paused")
    asking = asked(scene, scene.keypoints, {9: {"pause": True}, 19: {"pause": False}}, collected, record)
    paused = [json.loads(packet)["paused"] for packet in collected.packets]
    assert paused == [False] * 10 + [True] * 10 + [False] * 10
    assert [p.result is None for p in collected.poses] == paused and asking.session.processed == 20
    motion = read_motion(record.path)
    assert np.array_equal(motion.quality == 0.0, paused)
    x = scene.motion.segment_poses()[..., :3, 3]
    assert np.linalg.norm(motion.segment_poses()[-1, :, :3, 3] - x[-1], axis=1).mean() < 0.02


def test_another_person_is_tracked_and_recorded_alone(scene, collected, tmp_path):
    record = MotionRecord(tmp_path, rate=scene.motion.rate, up=scene.motion.up, name="other")
    first = asked(scene, scene.two, {}, collected)
    number = json.loads(collected.packets[9])["person"]
    asking = asked(scene, scene.two, {9: {"person": number}, 12: {"person": 3 - number}, 14: {"person": 7}},
                   collected := type(collected)(), record)  # fmt: skip
    assert [a["type"] for a in asking.answers] == ["done", "done", "refused"]
    packets = [json.loads(packet) for packet in collected.packets]
    assert {p["people"] for p in packets} == {2} and {p["camera"] for p in packets} == {scene.rig.names[0]}
    assert [p["person"] for p in packets] == [number] * 13 + [3 - number] * 17
    assert first.session.found == asking.session.found == len(scene.recording)
    motion = read_motion(record.path)
    roots = np.stack([scene.motion.Ts_world_root, scene.aside @ scene.motion.Ts_world_root])[:, 13:, :3, 3]
    gaps = np.linalg.norm(motion.Ts_world_root[:, :3, 3] - roots, axis=2)
    assert len(motion) == 17 and sorted(gaps.max(axis=1) < 0.05) == [False, True]


def test_sizes_and_detections_of_another_person_are_not_mixed(scene):
    class Part:
        restarts = 0

        def restart(self):
            self.restarts += 1

        def keep(self, frames):
            pass

        def after(self, frames, result):
            return None

        def close(self):
            pass

    seen, size, asking = Part(), Part(), Asking({9: {"person": 1}, 11: {"person": 2}})
    asking.session = LiveSession(
        scene.tracker(), [Replay(scene.recording, scene.two, speed=0.0)], [asking], seen=seen, size=size
    )  # fmt: skip
    size.outcome = ""
    asking.session.run()
    assert seen.restarts == size.restarts == 2
