"""A page is one file: nothing is fetched, everything is escaped, plots hold no NaN."""

import base64
import gzip
import hashlib
import json
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import AssetError, ExportError
from kinefit.exporters.report import page as p
from kinefit.readers import assets


def own(text):
    """The page without plotly.js, which is packed."""
    return re.sub(r'<script type="text/plain" id="plotly-gzip">[^<]*</script>', "", text)


def plots(text):
    return [json.loads(found) for found in re.findall(r'<script type="application/json">(.*?)</script>', text, re.S)]


@pytest.fixture
def plotly_js():
    p._plotly.cache_clear()  # another test may have had no network
    script, packed = p._plotly()
    if not packed and "could not fetch" in script:
        pytest.skip(f"the package index cannot be reached: {script}")
    assert packed, script
    return script


def test_a_page_names_no_address_outside_of_itself():
    image = np.zeros((20, 30, 3), np.uint8)
    text = p.page("All", [p.section("One", p.plot([{"x": [1], "y": [2]}]), p.picture(image), p.link("one", "up"))])
    assert "://" not in own(text)
    for address in re.findall(r'(?:src|href)="([^"]*)"', own(text)):
        assert address.startswith(("#", "data:image/")), address
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert "default-src 'none'" in policy and "http" not in policy


@pytest.mark.network
def test_a_page_runs_its_own_scripts_and_styles_alone(plotly_js):
    """By their hashes, as a browser takes them: of an element's whole text. plotly.js comes out of its package."""
    player = p.Html('<div class="player"></div>')
    shots = p.gallery([p.picture(np.zeros((4, 4, 3), np.uint8))], size="small")
    text = p.page("All", [p.plot([{"y": [1, 2]}]), p.table(["a"], [[p.shaded("x", 0.5)]]), player, shots])
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    allowed = dict(rule.split(" ", 1) for rule in policy.split("; "))

    def hashes(texts):
        return {f"'sha256-{base64.b64encode(hashlib.sha256(t.encode()).digest()).decode()}'" for t in texts}

    scripts = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert len(scripts) == 2 and set(allowed["script-src"].split()) == hashes([*scripts, plotly_js])
    assert set(allowed["style-src"].split()) == hashes([*re.findall(r"<style>(.*?)</style>", text, re.S), ""])
    assert "unsafe" not in policy and not re.search(r"<[^>]* (style|on\w+)=", own(text))


@pytest.mark.network
def test_plotly_is_there_once_and_whole_where_there_are_plots_and_not_elsewhere(plotly_js):
    two = p.page("Plots", [p.plot([{"y": [1, 2]}]), p.plot([{"y": [2, 1]}])])
    packed = re.findall(r'id="plotly-gzip">([^<]*)</script>', two)
    assert len(packed) == 1
    assert gzip.decompress(base64.b64decode(packed[0])).decode() == plotly_js
    assert len(two) < 2.5e6
    without = p.page("Text", [p.paragraph("no plot")])
    assert "plotly-gzip\">" not in without and len(without) < 30e3


def test_a_page_is_whole_but_for_its_plots_where_plotly_cannot_be_fetched(monkeypatch):
    def fetch(package):
        raise AssetError(f"pip could not fetch {package}: no network", remedy="Check the network.")

    monkeypatch.setattr(assets, "fetch", fetch)
    p._plotly.cache_clear()
    text = p.page("Plots", [p.section("One", p.paragraph("words"), p.plot([{"y": [1, 2]}], label="the knee"))])
    p._plotly.cache_clear()
    assert "could not fetch plotly 7.1.0: no network" in text and "kinefit warmup" in text and "words" in text
    assert plots(text)[0]["data"] == [{"y": [1, 2]}] and 'aria-label="the knee"' in text
    assert 'id="plotly-gzip"' not in text and len(text) < 30e3
    assert "plots of this page are missing" not in p.page("Text", [p.paragraph("no plot")])


EVIL = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(1)>&amp;"


def test_text_is_escaped_wherever_it_is_given():
    parts = [
        p.paragraph(EVIL, p.strong(EVIL), p.link(EVIL, EVIL), p.moment(1.0, EVIL)), p.callout("bad", EVIL, EVIL),
        p.heading(EVIL), p.bullets([EVIL]), p.folded(EVIL, EVIL), p.facts({EVIL: EVIL}), p.code(EVIL), p.quote(EVIL),
        p.table([EVIL], [[EVIL], [p.shaded(EVIL, 0.5)]], caption=EVIL), p.chooser(EVIL, {EVIL: EVIL}),
        p.picture(np.zeros((4, 4, 3), np.uint8), caption=EVIL), p.file_link(EVIL),
        p.plot([{"y": [1], "name": EVIL}], {"title": EVIL}, label=EVIL), EVIL,
    ]
    text = p.page(EVIL, [p.section(EVIL, *parts)], subtitle=EVIL)
    assert "<img src=x" not in text and "<script>alert" not in text
    assert plots(text)[0]["data"][0]["name"] == EVIL


@given(st.text(), st.lists(st.floats(), max_size=5))
def test_json_comes_back_with_gaps_for_what_is_not_finite(name, values):
    text = p.to_json({"name": name, "y": np.array(values), "rows": [np.float32(1.5), np.int64(3), True, None]})
    assert "<" not in text
    back = json.loads(text)
    assert back["name"] == name and back["rows"] == [1.5, 3, True, None]
    for value, told in zip(values, back["y"], strict=True):
        assert told is None if not np.isfinite(value) else told == pytest.approx(value, rel=1e-5)


def decoded(html):
    kind, data = re.search(r'src="data:image/(\w+);base64,([^"]+)"', html).groups()
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    return kind, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def test_a_picture_keeps_its_colours_and_is_no_larger_than_asked():
    image = np.zeros((300, 900, 3), np.uint8)
    image[:] = (200, 60, 20)
    kind, shown = decoded(p.picture(image, width=450))
    assert kind == "jpeg" and shown.shape == (150, 450, 3)
    assert np.abs(shown.astype(int) - (200, 60, 20)).max() < 6
    kind, shown = decoded(p.picture(image[:9, :9], lossless=True))
    assert kind == "png" and np.array_equal(shown, image[:9, :9])
    tall = decoded(p.picture(np.ascontiguousarray(image.transpose(1, 0, 2)), width=300))[1]
    assert tall.shape == (300, 100, 3)


@pytest.mark.parametrize("wrong", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_what_is_no_picture_is_refused(wrong):
    with pytest.raises(ExportError, match="uint8 RGB"):
        p.picture(wrong)


def test_the_contents_link_to_the_sections_and_choices_show_the_first():
    choices = p.chooser("Joint", {"hip": "1", "knee": "2"})
    text = p.page("Two", [p.section("First part", "a"), p.section("Second", choices)])
    assert '<a href="#first-part">First part</a>' in text and '<section id="first-part">' in text
    assert re.findall(r'<div class="choice"( hidden)?>', text) == ["", " hidden"]


def test_shades_grow_with_the_share_and_unknown_has_none():
    style, grounds = p._shades(), []
    for share in (0.0, 0.5, 1.0, 7.0):
        name = re.search(r'class="([^"]*)"', p.shaded("x", share))[1]
        grounds.append(re.search(rf"\.{name} {{ background: rgb\((\d+),(\d+),(\d+)\)", style).groups())
    blue = [int(ground[2]) for ground in grounds]
    assert blue[0] == 255 > blue[1] > blue[2] == blue[3]
    assert "class" not in p.shaded("–", np.nan)


def test_the_files_that_a_page_is_made_of_name_no_address():
    for name in ("page.css", "page.js", "player.js"):
        assert "//" not in re.sub(r"^\s*//.*$|\s//\s.*$", "", p._resource(name), flags=re.M), name
