"""What a take needs before it is tracked."""

import pytest

from kinefit.preparing import take as preparing
from kinefit.preparing.take import ensure_detections, has_fingers


def test_only_bodies_with_fingers_need_points_of_hands():
    assert [has_fingers(name) for name in ("humanoid_hands", "humanoid", "humanoid10", "anny")] == [True] + 3 * [False]


@pytest.mark.parametrize(("body", "hands"), [("humanoid_hands", True), ("humanoid", None)])
def test_the_detector_looks_for_hands_where_the_body_has_fingers(body, hands, monkeypatch):
    asked = {}
    monkeypatch.setattr(preparing, "jobs_of_take", lambda take: [])
    monkeypatch.setattr(preparing, "detect", lambda jobs, **settings: asked.update(settings))
    monkeypatch.setattr(preparing, "somebody", lambda jobs, tell: {})
    ensure_detections(type("Take", (), {"body": body}))
    assert asked["hands"] is hands
