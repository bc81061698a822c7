"""The server answers, the scene's nodes stand where the motion says, and a page holds it all."""

import base64
import re
import sys
import types
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
import websockets
import websockets.sync.client
from tests.exporters.synthetic import a_camera, smooth_motion
from tests.studio.serving.probing import probe
from tests.studio.viewers.recordings import RATE, write_video

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.rendering.looks import LEFT_COLOUR, LOST_COLOUR, RIGHT_COLOUR
from kinefit.errors import BodyError, CalibrationError, ExportError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import Markers
from kinefit.simulation import cut
from kinefit.studio.serving.access import Access
from kinefit.studio.viewers import CameraImages, Choice, Player, View, ViewerContent, page
from kinefit.studio.viewers.show import ALL_CAMERAS, CYLINDERS, MOST_FRAMES, Show, chosen_frames
from kinefit.studio.viewers.stage import open_server, quiet

ACCESS = Access()


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(8, rate=RATE)


@pytest.fixture(scope="module")
def rig():
    return Rig([a_camera("cam 0", 0.0), a_camera("cam 1", 0.7)])


@pytest.fixture
def server():
    server = open_server(0, ACCESS)
    yield server
    with quiet():
        server.stop()


def node(server, name):
    return server.scene.get_handle_by_name(f"/world/{name}")


def test_the_page_is_served(server, motion):
    Player(server, ViewerContent((motion,))).tick(0.0)
    address = ACCESS.url(server.get_port())
    with urllib.request.urlopen(address, timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read()[:1000].lower()
        policy = answer.headers["Content-Security-Policy"]
        assert "connect-src 'self'" in policy and "default-src 'self'" in policy
        assert policy.endswith("frame-ancestors http://localhost:* http://127.0.0.1:*")
    with viser_client(address) as client:
        assert len(client.recv(timeout=10)) > 1000  # the scene so far, compressed


def viser_client(address, **options):
    """A WebSocket as viser's page opens it: without the slash at the end."""
    import viser

    address = address.replace("http", "ws", 1).rstrip("/")
    protocols = [f"viser-v{viser.__version__}"]
    return websockets.sync.client.connect(address, subprotocols=protocols, max_size=None, **options)


def test_a_foreign_page_gets_no_scene(server):
    port = server.get_port()
    own, bare = ACCESS.url(port), f"http://localhost:{port}/"
    for address in (bare, f"{bare}another-token-of-24-char/"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address, timeout=10)
        with pytest.raises(websockets.InvalidStatus, match="403"):
            viser_client(address)
    for headers, status in (({"Origin": "https://evil.example"}, 403), ({"Host": f"evil.example:{port}"}, 421)):
        with pytest.raises(urllib.error.HTTPError, match=str(status)):
            urllib.request.urlopen(urllib.request.Request(own, headers=headers), timeout=10)
    with pytest.raises(websockets.InvalidStatus, match="403"):
        viser_client(own, origin="https://evil.example")
    with viser_client(own, origin=f"http://localhost:{port}") as client:
        assert client.recv(timeout=10)


def test_probes_print_nothing(server, capfd, caplog):
    probe(server.get_port())
    with viser_client(ACCESS.url(server.get_port())) as client:
        assert client.recv(timeout=10)
    assert capfd.readouterr() == ("", "") and not [record for record in caplog.records if record.exc_info]


def test_a_viser_that_cannot_be_guarded_is_not_served(monkeypatch):
    import viser

    stopped = []
    other = types.SimpleNamespace(stop=lambda: stopped.append(True))
    monkeypatch.setattr(viser, "ViserServer", lambda **_: other)
    with pytest.raises(ExportError, match="is not supported"):
        open_server(0)
    assert stopped


def test_segments_stand_where_the_motion_says(server, motion):
    show = Show(server, ViewerContent((motion,)))
    for f in (3, 0):
        show.frame(f)
        for name, T in zip(motion.body.tree.segments, motion.segment_poses()[f], strict=True):
            frame = node(server, f"body0/{name}")
            assert np.allclose(frame.position, T[:3, 3], atol=1e-5)
            assert np.allclose(se3.rotation_from_quaternion(frame.wxyz), T[:3, :3], atol=1e-5)
            assert np.allclose(node(server, f"body0/at_{name}").position, T[:3, 3], atol=1e-5)


def test_the_skin_moves_with_the_segments_and_shows_what_is_lost_or_uncertain(server, motion):
    quality, std = np.ones_like(motion.segment_quality), np.full_like(motion.joint_std, 0.01)
    quality[3, motion.body.tree.segment("shank_l")] = 0.0
    std[3, motion.body.tree.segment("hand_r")] = 0.2
    told = replace(motion, segment_quality=quality, joint_std=std)
    show = Show(server, ViewerContent((told,)))
    show.frame(3)
    for bone, s in show.figures[0]._followers:
        assert np.allclose(bone.position, motion.segment_poses()[3, s, :3, 3], atol=1e-5)
        assert np.allclose(se3.rotation_from_quaternion(bone.wxyz), motion.segment_poses()[3, s, :3, :3], atol=1e-5)
    lost, unsure, good = (node(server, f"body0/skin_{name}") for name in ("shank_l", "hand_r", "thigh_l"))
    assert good.opacity is None and good.color == LEFT_COLOUR
    assert 0 < lost.opacity < unsure.opacity < 1 and lost.color == LOST_COLOUR and unsure.color == RIGHT_COLOUR
    dashes, solid = node(server, "body0/shank_l/bones"), node(server, "body0/thigh_l/bones")
    gaps = node(server, "body0/shank_l/gaps")
    assert gaps.opacity == 0.0 and not gaps.visible and solid.opacity == 0.0  # in the skin, only a lost one has a line
    assert dashes.visible and dashes.opacity is None and dashes.color == LOST_COLOUR
    show.frame(3, Choice(CYLINDERS))
    assert gaps.opacity == 0.0 and gaps.visible and solid.opacity is None and dashes.opacity is None
    show.frame(0)
    assert lost.opacity is None and lost.color == LEFT_COLOUR and node(server, "body0/shank_l/gaps").opacity is None
    show.frame(0, Choice(through="cam 0"))
    assert good.opacity == 0.5


def test_without_surfaces_the_bones_stand_for_the_skin(server, motion):
    show = Show(server, ViewerContent((replace(motion, body=replace(motion.body, surfaces=())),)))
    show.frame(0)
    assert node(server, "body0/pelvis/bones").visible and node(server, "body0/shank_l/gaps").visible


def test_cylinders_are_shown_where_they_are_asked_for(server, motion):
    Player(server, ViewerContent((motion,)), layers=CYLINDERS).tick(0.0)
    assert node(server, "body0/thigh_l/surface").visible and node(server, "body0/thigh_l/bones").visible
    assert not node(server, "body0/skin_thigh_l").visible


def test_ellipsoids_are_two_sigmas_to_a_tenth(server, motion):
    Show(server, ViewerContent((motion,))).frame(2)
    assert not node(server, "body0/at_pelvis/uncertainty").visible  # until somebody asks for them
    for name, std in zip(motion.body.tree.segments, motion.joint_std[2], strict=True):
        assert np.allclose(node(server, f"body0/at_{name}/uncertainty").scale, 2 * std, rtol=0.06)


def test_layers_are_shown_and_hidden(server, motion, rig):
    show = Show(server, ViewerContent((motion,), rig=rig))
    assert node(server, "body0/skin_thigh_l").visible
    show.frame(0, Choice(frozenset({"bones", "cameras"})))
    assert node(server, "body0/thigh_l/bones").visible and not node(server, "body0/thigh_l/surface").visible
    assert not node(server, "body0/skin_thigh_l").visible
    assert node(server, "cameras/cam 0").visible and not node(server, "floor").visible
    show.frame(0, Choice(frozenset({"surface", "floor", "path"}), through="cam 1"))
    assert not node(server, "body0/thigh_l/bones").visible and node(server, "body0/thigh_l/surface").visible
    assert not node(server, "cameras/cam 0").visible and node(server, "floor").visible
    assert node(server, "path0").visible


def test_a_camera_stands_and_looks_as_it_was_calibrated(server, motion, rig):
    Show(server, ViewerContent((motion,), rig=rig)).frame(0)
    for camera in rig:
        frustum = node(server, f"cameras/{camera.name}")
        assert np.allclose(frustum.position, camera.centre_world, atol=1e-6)
        assert np.allclose(se3.rotation_from_quaternion(frustum.wxyz)[:, 2], camera.T_camera_world[2, :3], atol=1e-6)


def test_the_backdrop_is_where_its_pixels_are_seen(server, motion, rig, tmp_path):
    video = write_video(tmp_path / "a.mkv", 90, size=(64, 96))
    pictures = CameraImages({c.name: c for c in rig}, {"cam 0": video})
    show = Show(server, ViewerContent((motion,), rig=rig, pictures=pictures))
    show.frame(1, Choice(through="cam 0"))
    back, camera = node(server, "backdrop/cam 0"), rig["cam 0"]
    side = se3.rotation_from_quaternion(back.wxyz)
    corner = back.position - 0.5 * (back.render_width * side[:, 0] + back.render_height * side[:, 1])
    at = camera.T_camera_world[:3, :3] @ corner + camera.T_camera_world[:3, 3]
    assert np.allclose(show.stage.cameras["cam 0"].view.pixels(at), -0.5, atol=1e-3)  # of the first pixel
    assert at[2] > (motion.positions() @ camera.T_camera_world[2, :3]).max() + camera.T_camera_world[2, 3]
    assert node(server, "cameras/cam 1").image is None
    show.frame(1, Choice())
    assert node(server, "backdrop/cam 0") is None and node(server, "cameras/cam 0").image is not None
    pictures.close()


def test_rays_of_one_camera_or_of_all(server, motion, rig):
    show = Show(server, ViewerContent((motion,), rig=rig))
    one, other = show.rays(2, "cam 0"), show.rays(2, "cam 1")
    assert len(show.rays(2, ALL_CAMERAS).points) == len(one.points) + len(other.points)
    show.frame(2, Choice(rays="cam 1"))
    assert np.allclose(node(server, "rays").points, other.points, atol=1e-5) and node(server, "rays").visible
    show.frame(2, Choice())
    assert not node(server, "rays").visible


def test_a_second_motion_goes_by_time_and_is_turned(server, motion):
    late = smooth_motion(8, rate=RATE, up="z")
    object.__setattr__(late, "times", late.times + 2 / RATE)
    show = Show(server, ViewerContent((motion, late)))
    show.frame(5)
    assert np.allclose(node(server, "body1/pelvis").position, motion.Ts_world_root[3, :3, 3], atol=1e-5)
    show.frame(0)
    assert not node(server, "body1").visible and node(server, "body0").visible


def test_markers_and_points_where_they_are_known(server):
    x = np.random.default_rng(0).normal(size=(4, 3, 3))
    x[2, 1] = np.nan
    markers = Markers(("a", "b", "c"), 10.0, x, up="z")
    show = Show(server, ViewerContent(markers=(markers,), marker_offsets=(0.5,), steps=np.arange(10) / 10))
    show.frame(7)
    assert np.allclose(node(server, "markers0/0").position, x[2, 0]) and not node(server, "markers0/1").visible
    show.frame(8)
    assert node(server, "markers0/1").visible
    show.frame(2)  # before the markers begin
    assert not node(server, "markers0").visible


def test_measured_markers_of_a_motion(server, motion):
    Show(server, ViewerContent((motion,))).frame(1)
    assert np.allclose(node(server, "markers0/4").position, motion.residuals["markers/1"].measured[1, 4], atol=1e-6)


def test_following_keeps_the_body_in_place(server, motion):
    show = Show(server, ViewerContent((motion,)))
    show.frame(6, Choice(follow=True))
    way = motion.Ts_world_root[0, :3, 3] - motion.Ts_world_root[6, :3, 3]
    shift = server.scene.get_handle_by_name("/world").position
    assert np.allclose(shift[[0, 2]], way[[0, 2]], atol=1e-6) and shift[1] == 0  # y is up: the floor stays level
    show.frame(6, Choice())
    assert np.allclose(server.scene.get_handle_by_name("/world").position, 0)


def test_a_long_way_is_followed_from_nearby(server):
    walk = smooth_motion(300, rate=RATE)  # 8 m
    show = Show(server, ViewerContent((walk,)))
    assert show.stage.goes_far
    body = show.recording.first_places()
    assert np.linalg.norm(server.initial_camera.look_at - body.mean(axis=0)) < 0.3
    assert 0.5 < filled(body, server.initial_camera) < 0.9


def test_markers_are_followed_by_their_middle():
    x = np.random.default_rng(1).normal(size=(5, 7, 3))
    x[2], x[1, 3] = np.nan, np.nan
    recording = ViewerContent(markers=(Markers(tuple("abcdefg"), 10.0, x),), marker_offsets=(0.0,))
    way = recording.way()
    assert np.allclose(way[[0, 4]], np.median(x[[0, 4]], axis=1)) and np.allclose(way[2], (way[1] + way[3]) / 2)
    assert np.allclose(way[1], np.nanmedian(x[1], axis=0))


def test_a_short_one_is_seen_whole(server, motion, rig):
    show = Show(server, ViewerContent((motion,), rig=rig))
    places, look = show.recording.places, server.initial_camera
    assert not show.stage.goes_far and np.allclose(look.look_at, 0.5 * (places.min(0) + places.max(0)))
    away = (places - look.position) @ (look.look_at - look.position)
    across = np.linalg.norm(np.cross(places - look.position, look.look_at - look.position), axis=1)
    assert np.all(away > 0) and np.all(across < np.tan(look.fov / 2) * away)


def filled(points, look):
    """Share of the window's height over which points (N, 3) are seen; all of them."""
    axis = (look.look_at - look.position) / np.linalg.norm(look.look_at - look.position)
    upright = look.up - (look.up @ axis) * axis
    seen = (points - look.position) @ (upright / np.linalg.norm(upright)) / ((points - look.position) @ axis)
    assert np.abs(seen).max() < np.tan(look.fov / 2)
    return np.ptp(seen) / (2 * np.tan(look.fov / 2))


def test_the_first_look_is_at_the_person_from_the_front_however_far_the_cameras_are(server, motion):
    still = cut(motion, 0, 1)
    far = Rig([camera.with_pose(se3.transform(np.eye(3), [0, 0, 30.0]) @ camera.T_camera_world)
               for camera in (a_camera("cam 0", 0.0), a_camera("cam 1", 0.7))])  # fmt: skip
    for rig in (None, far):
        show, look = Show(server, ViewerContent((still,), rig=rig)), server.initial_camera
        assert 0.5 < filled(show.recording.first_places(), look) < 0.9
        assert (look.position - look.look_at) @ still.Ts_world_root[0, :3, 0] > 0.3


def test_the_player_plays_steps_and_obeys_its_boxes(server, motion, rig):
    player = Player(server, ViewerContent((motion,), rig=rig))
    player.tick(0.0)
    player.clock.playing = True
    player.tick(3.2 / RATE)
    assert player.clock.frame == 3 and np.allclose(
        node(server, "body0/pelvis").position, motion.Ts_world_root[3, :3, 3], atol=1e-5
    )
    player.clock.step(1)
    player.tick(0.0)
    assert player._slider.value == 4
    player._slider.value = 6  # as a user moves it
    player.tick(0.0)
    assert player.clock.frame == 6
    assert not player._boxes["bones"].value and player._boxes["skin"].value
    player._rays.value, player._look.value, player._colour.value = ALL_CAMERAS, "cam 1", "quality"
    player.tick(0.0)
    assert node(server, "body0/thigh_l/bones").opacity == 0.0 and node(server, "rays").visible
    assert not node(server, "cameras/cam 1").visible and node(server, "cameras/cam 0").visible
    player._plots[0].box.value = "elbow_flex_l"
    player.tick(0.0)
    assert "elbow_flex_l" in player._plots[0].line.content


def test_nothing_to_show_is_told():
    with pytest.raises(ObservationError, match="no frame"):
        ViewerContent()


def test_a_host_that_is_none_is_told():
    with pytest.raises(ExportError, match="no.such.host"):
        open_server(0, Access("no.such.host.invalid"))


def test_without_viser_the_remedy_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ExportError, match="pip install viser"):
        open_server(0)


def test_a_page_is_one_file_with_all_in_it(motion, rig):
    text, frames = page(ViewerContent((motion,), rig=rig))
    assert frames == len(motion)
    assert len(base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)[1])) > 10_000
    assert not re.search(r'(?:src|href)="https?://', text)
    assert re.search(r'<head><meta http-equiv="Content-Security-Policy" content="connect-src', text)


def test_a_page_that_plays_again_shows_the_first_frame_as_it_was(server, motion):
    """What only changes are sent of is all sent at the start: colours, and sizes of error bars."""
    show = Show(server, ViewerContent((motion,)))
    body = show.figures[0]
    show.frame(0)

    def looks():
        shaded = [(node.color, node.opacity) for nodes in body._shaded for node, _, _ in nodes]
        return [*shaded, *(node.scale for node in body._parts["uncertainty"])]

    first = looks()
    body.blank()
    assert not any(a == b for a, b in zip(first, looks()))
    show.frame(0)
    assert looks() == first


@pytest.mark.parametrize(
    ("count", "most"), [(5, 10), (10, 10), (11, 10), (1000, 7), (1, 1), (MOST_FRAMES * 3 + 1, MOST_FRAMES)]
)
def test_frames_are_thinned_evenly(count, most):
    chosen = chosen_frames(count, most)
    assert len(chosen) <= most and chosen[0] == 0 and chosen[-1] < count
    assert len(set(np.diff(chosen))) <= 1
    assert len(chosen) == count or len(chosen) > most / 2


def test_a_live_view_follows_states(rig):
    body = load_body("humanoid")
    with View(body, rig, up="y", port=0) as view:
        state = body.default_state(se3.transform(np.eye(3), np.array([0.3, 0.9, 0.1])))
        image = np.full((480, 320, 3), 90, np.uint8)
        view.show(state, time=1.25, images={"cam 0": image})
        assert np.allclose(node(view.server, "body/pelvis").position, (0.3, 0.9, 0.1))
        assert node(view.server, "cameras/cam 0").image.max() == 90
        assert "1.250 s" in view._time.content and " Hz" in view._time.content
        assert [line.split()[0] for line in view._angles.content.split("\n\n")] == list(body.tree.coordinates)
        bent = np.full(len(state.angles), np.pi / 6)
        view._told -= 1.0
        view.show(BodyState(state.T_world_root, bent))
        assert "knee_angle_r **30.0**°" in view._angles.content
        with urllib.request.urlopen(view.address, timeout=10) as answer:
            assert answer.status == 200
        with pytest.raises(BodyError, match="3 angles"):
            view.show(BodyState(np.eye(4), np.zeros(3)))
        with pytest.raises(CalibrationError, match="cam 7"):
            view.show(state, images={"cam 7": image})


def test_a_view_that_a_network_reaches_warns():
    with pytest.warns(UserWarning, match="open to the network"), View(load_body("arm"), port=0, host="0.0.0.0"):
        pass
