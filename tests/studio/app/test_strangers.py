"""Names, reports and pages of strangers get nowhere in a real browser."""

import pytest

pytest.importorskip("nicegui")
pytest.importorskip("playwright")
from tests.studio.app.attacking import attacks

pytestmark = pytest.mark.slow


def test_each_attack_is_refused(browser, drawn_take, tmp_path):
    refused = attacks(browser, drawn_take, tmp_path)
    assert len(refused) == 11 and [attack for attack, is_refused in refused.items() if not is_refused] == []
