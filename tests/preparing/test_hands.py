"""Hands are looked for where the take's body has fingers."""

from pathlib import Path

import pytest

from kinefit.preparing import take as preparing
from kinefit.readers.take.file import read_take


@pytest.mark.parametrize(("body", "hands"), [("humanoid", None), ("humanoid_hands", True), ("anny", None)])
def test_a_body_with_fingers_has_its_hands_looked_for(tmp_path, monkeypatch, body, hands):
    asked = {}
    monkeypatch.setattr(preparing, "detect", lambda jobs, **how: asked.update(how))
    monkeypatch.setattr(preparing, "somebody", lambda jobs, tell: {"cam": Path("cam.npz")})
    (tmp_path / "cam.mp4").touch()
    (tmp_path / "take.toml").write_text(f'[take]\nbody = "{body}"\n[[camera]]\nname = "cam"\nvideo = "cam.mp4"\n')
    take = preparing.with_detections(read_take(tmp_path / "take.toml"))
    assert asked["hands"] is hands and [entry.camera for entry in take.keypoints] == ["cam"]
