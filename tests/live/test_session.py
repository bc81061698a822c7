"""A session gives what the tracker gives, tells receivers, and does what clients ask for."""

import json

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.live.cameras import CameraSource, Clock
from kinefit.live.people import LivePerson
from kinefit.live.session import LiveSession


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


@pytest.mark.parametrize(
    ("wish", "told"),
    [
        ({"sensor": "cam1"}, "nothing to change"), ({"sensor": "nowhere", "use": False}, "no sensor 'nowhere'"),
        ({"sensor": "cam1", "sigma": -1}, "positive"), ({"sensor": "cam1", "sigma": "wide"}, "positive"),
        ({"body": "/etc/passwd"}, "no body of the catalogue"), ({"fly": True}, "nothing that can be asked"),
    ],
)
def test_what_cannot_be_done_is_refused_and_the_session_goes_on(scene, collected, wish, told):
    session, answers = LiveSession(scene.tracker(), [scene.replay()], [collected]), []
    wish = {k: (scene.rig.names[0] if v == "cam1" else v) for k, v in wish.items()}
    session.ask({**wish, "answer": answers.append})
    session.run()
    assert answers[0]["type"] == "refused" and told in answers[0]["why"]
    assert session.processed == len(scene.recording)


def test_sensors_and_weights_change_while_it_runs(scene, collected):
    session, answers = LiveSession(scene.tracker(), [scene.replay()], [collected]), []
    name = scene.rig.names[0]
    session.ask({"sensor": name, "use": False, "answer": answers.append})
    session.ask({"sensor": scene.rig.names[1], "sigma": 30.0, "answer": answers.append})
    session.run()
    assert [a["type"] for a in answers] == ["done", "done"]
    assert session.tracker.accuracy[scene.rig.names[1]] == 30.0
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


def test_a_source_that_fails_ends_the_session_with_its_error(scene, collected):
    stream = CameraSource("cam", (64, 48), Clock())
    session = LiveSession(scene.tracker(), [stream], [collected])
    stream._run = lambda inbox: stream._bring(inbox, np.zeros((10, 10, 3), np.uint8), 0.0)
    with pytest.raises(ObservationError, match="images of 10x10 px"):
        session.run()
    assert collected.closed
