"""`kinefit app` in Chromium, as a user goes through it by clicks: drop videos, wait, look at the report.

The four videos of the balancing trial, and one of a walk (video_mono_opencap), are dropped as they are.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.commands import command, ended
from benchmarks.figures import LEFT_OUT, NotMeasured, data, figure, quick
from benchmarks.house.house_size import PACKAGE, code_lines
from benchmarks.timing import took

_GOALS = {
    "window_first_image": ("s", "<= 5"), "window_answer": ("ms, 95 of 100", "<= 200"), "window_cost": ("%", "<= 3"),
    "window_four_videos": ("typed words to the report", "== 0"), "window_one_video": ("typed words", "== 0"),
}  # fmt: skip
_TOKEN = "a-token-of-the-benchmark"
WAIT_MS = 900_000.0
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_CLICK = """() => new Promise(done => {
  const field = document.querySelector('input[aria-label=Folder]'), before = field.value, since = performance.now();
  document.querySelector('.q-item').click();
  const timer = setInterval(() => {
    if (field.value !== before) { clearInterval(timer); done(performance.now() - since); }
  }, 5);
})"""
"""A click on the first entry, one folder up, as a browser times it."""

_COUNT_KEYS = "window.typed = 0; window.addEventListener('keydown', () => { window.typed += 1 }, true)"


def run() -> None:
    """Print every figure."""
    lines = sum(code_lines(path.read_text("utf-8")) for path in (PACKAGE / "studio" / "app").rglob("*.py"))
    texts = sum(len(path.read_text("utf-8").splitlines()) for path in (PACKAGE / "studio" / "app").glob("*.toml"))
    print(f"# {lines} lines of code, {texts} of texts in two languages")
    figure("window_lines", lines + texts, "lines", "<= 2500")
    four, walk = data("video_balancing_4cam"), data("video_mono_opencap")
    missing = LEFT_OUT if quick() else "no Chromium" if CHROMIUM is None else ""
    missing = missing or ("" if four and walk else "no recordings")
    if missing:
        raise NotMeasured(missing)
    assert four is not None and walk is not None
    with chromium() as browser:
        videos = sorted((four / "videos").glob("*.mp4"))
        first, _, typed, spent = _dropped(browser, videos, answers=0)
        answers = _dropped(browser, videos)[1]
        figure("window_first_image", first, *_GOALS["window_first_image"])
        middle, most = np.median(answers), max(answers)
        print(f"# {len(answers)} answers while it computes: median {middle:.0f} ms, at most {most:.0f} ms")
        figure("window_answer", float(np.percentile(answers, 95)), *_GOALS["window_answer"])
        figure("window_four_videos", typed, *_GOALS["window_four_videos"])
        alone = _by_command(videos)
        print(f"# the same by the command {alone:.1f} s, in the window {spent:.1f} s, each from undetected videos")
        figure("window_cost", 100.0 * (spent / alone - 1.0), *_GOALS["window_cost"])
        figure("window_one_video", _dropped(browser, _one_video(walk), answers=0)[2], *_GOALS["window_one_video"])


def _one_video(walk: Path) -> list[Path]:
    return sorted((walk / "walk_ts").rglob("*.mp4"))[:1] or sorted(walk.rglob("*.mp4"))[:1]


@contextmanager
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])


@contextmanager
def running_app(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running app, and its address."""
    words = command("app", folder, "--port", 0, "--token", _TOKEN, "--no-browser")
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        found = re.search(r"http://\S+/", process.stdout.readline())
        assert found is not None, "the app did not start"
        yield process, found[0]
    finally:
        process.kill()
        process.communicate()


def open_page(browser: Any, address: str) -> Any:
    """A window of the app in which faces are shown."""
    page = browser.new_context(viewport={"width": 1300, "height": 900}, locale="en-GB").new_page()
    page.set_default_timeout(WAIT_MS)
    page.add_init_script(_COUNT_KEYS)
    page.goto(address)
    page.get_by_role("button", name="Show faces").click()
    page.get_by_text("Open a recording").wait_for()
    return page


def _dropped(browser: Any, videos: list[Path], *, answers: int = 60) -> tuple[float, list[float], int, float]:
    """Drop videos and go on to the report: time of the first image [s], answers meanwhile [ms], keys, fit [s]."""
    with tempfile.TemporaryDirectory() as work, running_app(_session(work)) as (_, address):
        page, other = open_page(browser, address), None
        since = time.perf_counter()
        page.locator("input[type=file]").set_input_files(videos)
        page.wait_for_function("[...document.images].some(image => image.complete && image.naturalWidth > 40)")
        first = time.perf_counter() - since
        page.get_by_role("button", name="Compute the motion").click()
        since, answered = time.perf_counter(), []
        other = browser.new_context(locale="en-GB").new_page() if answers else None
        if other is not None:
            other.goto(address)
            other.get_by_text("One folder up").wait_for()
        while not page.get_by_role("link", name="Report").count():
            if other is not None and len(answered) < answers:
                answered.append(_answer(other))
            page.wait_for_timeout(500)
        spent = time.perf_counter() - since
        typed = page.evaluate("window.typed")
        with page.context.expect_page() as opened:
            page.get_by_role("link", name="Report").first.click()
        opened.value.get_by_text("Summary").first.wait_for(state="attached")
        page.context.close()
        if other is not None:
            other.context.close()
        return first, answered, typed, spent


def _session(work: str) -> Path:
    """A folder of recordings in a folder with few others: a list of hundreds is another question (0.15 s for 265)."""
    folder = Path(work) / "session"
    folder.mkdir()
    return folder


def _answer(page: Any) -> float:
    """Time [ms] from a click into the list of folders until the page shows the folder."""
    before = page.locator("input[aria-label=Folder]").input_value()
    spent = float(page.evaluate(_CLICK))
    page.get_by_text(Path(before).name, exact=True).first.click()
    page.wait_for_timeout(1000)
    return spent


def _by_command(videos: list[Path]) -> float:
    """Time [s] of `kinefit track` on copies of videos in which nothing is detected yet."""
    with tempfile.TemporaryDirectory() as work:
        for video in videos:
            shutil.copyfile(video, Path(work) / video.name)
        return took(lambda: ended("track", work, check=True), clock=time.perf_counter)[1]
