"""Hands and faces are looked for where the take's body has them, faces also where the take names them."""

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import pytest

from kinefit.readers.take.file import read_take
from kinefit.takes.preparing import take as preparing


@pytest.mark.parametrize(("body", "hands"), [("humanoid", None), ("humanoid_hands", True), ("anny", None)])
def test_a_body_with_fingers_has_its_hands_looked_for(tmp_path, monkeypatch, body, hands):
    asked = {}
    monkeypatch.setattr(preparing, "detect", lambda jobs, settings, **how: asked.update(asdict(settings)))
    monkeypatch.setattr(preparing, "somebody", lambda jobs, tell: {"cam": Path("cam.npz")})
    (tmp_path / "cam.mp4").touch()
    (tmp_path / "take.toml").write_text(f'[take]\nbody = "{body}"\n[[camera]]\nname = "cam"\nvideo = "cam.mp4"\n')
    take = preparing.with_detections(read_take(tmp_path / "take.toml"))
    assert asked["hands"] is hands and [entry.camera for entry in take.keypoints] == ["cam"]


def prepare(tmp_path, monkeypatch, body, more="", faces=("cam",)):
    """The take with its keypoints, what was asked of the detector, and what was said; `faces`: cameras that see one."""
    asked, said = {}, []
    cameras = {name: tmp_path / f"{name}.npz" for name in ("cam", "back")}
    monkeypatch.setattr(preparing, "detect", lambda jobs, settings, **how: asked.update(asdict(settings)))
    monkeypatch.setattr(preparing, "somebody", lambda jobs, tell: cameras)
    monkeypatch.setattr(preparing, "read_detections", lambda file: SimpleNamespace(has_faces=file.stem in faces))
    text = f'[take]\nbody = "{body}"\n'
    for name in cameras:
        (tmp_path / f"{name}.mp4").touch()
        text += f'[[camera]]\nname = "{name}"\nvideo = "{name}.mp4"\n'
    (tmp_path / "take.toml").write_text(text + more)
    return preparing.with_detections(read_take(tmp_path / "take.toml"), tell=said.append), asked, said


def test_a_body_with_a_jaw_has_its_face_looked_for(tmp_path, monkeypatch):
    take, asked, said = prepare(tmp_path, monkeypatch, "humanoid_face")
    assert asked["face"] is True and asked["hands"] is None and not said
    assert [(k.camera, k.set) for k in take.keypoints] == [("cam", None), ("back", None), ("cam", "MEDIAPIPE_478")]
    take, _, said = prepare(tmp_path, monkeypatch, "humanoid_face", faces=())
    assert [k.set for k in take.keypoints] == [None, None] and "No face" in said[0]


def test_a_take_that_names_faces_has_them_looked_for(tmp_path, monkeypatch):
    named = '[[keypoints]]\ncamera = "cam"\nformat = "detect"\n'
    assert prepare(tmp_path, monkeypatch, "humanoid", named)[1]["face"] is None
    assert prepare(tmp_path, monkeypatch, "humanoid", named + named + 'set = "MEDIAPIPE_478"\n')[1]["face"] is True
