"""Images of pages in the browser: report, check, clicks, 3D viewer, live session, the app."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlencode

import numpy as np

import kinefit
from drawing import results
from drawing.browser import Browser
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations


@contextmanager
def served(*words: object) -> Iterator[str]:
    """Run a `kinefit` command that serves a page, and give its address."""
    command = [sys.executable, "-u", "-m", "kinefit", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            told = ""
            for line in process.stdout:
                told += line
                if address := re.search(r"https?://\S+", line):
                    yield address[0]
                    return
            raise SystemExit(told)
        finally:
            process.terminate()


def report() -> None:
    """The demo's report: its top, and its moving figure with what follows."""
    with Browser((800, 900)) as browser:
        browser.open((results.demo() / "report.html").as_uri())
        time.sleep(3.0)
        top = browser.image()
        browser.run("[...document.querySelectorAll('a')].find(e => e.textContent === 'Moving figure').click()")
        time.sleep(5.0)
        results.save("report.png", np.hstack([top, browser.image()]))


def check() -> None:
    """The page of `kinefit check` of the demo's take."""
    page = results.folder("check") / "check.html"
    if not page.is_file():
        results.command("check", results.demo() / "take" / "take.toml", "--out", page)
    with Browser((900, 900)) as browser:
        browser.open(page.as_uri())
        results.save("check.png", browser.image(1560))


def live() -> None:
    """The page of `kinefit live` while it replays the demo's take."""
    take, out = results.demo() / "take" / "take.toml", results.folder("live")
    with served("live", take, "--out", out, "--speed", 0.05, "--port", 0) as address, Browser((1000, 680)) as browser:
        browser.open(address)
        time.sleep(25.0)
        results.save("live.jpg", browser.image())


def view() -> None:
    """The 3D viewer of the demo's results: rays of a camera, and the view through another one."""
    words = ("view", results.demo(), "--port", 0, "--no-browser", "--hide-faces")
    with served(*words) as address, Browser((1000, 680)) as browser:
        browser.open(address)
        _choose(browser, "rays of", "cam02")
        for _ in range(4):
            browser.run("[...document.querySelectorAll('button')].find(e => e.textContent === '+10').click()")
            time.sleep(0.5)
        browser.run("document.querySelectorAll('[role=alert] button').forEach(e => e.click())")  # slow rendering
        time.sleep(15.0)
        left = browser.image()
        _choose(browser, "rays of", "none")
        _choose(browser, "look through", "cam04")
        time.sleep(15.0)
        right = browser.image()[:, 310:664]  # the camera's image is upright, in the middle of the window
    results.save("view.png", np.hstack([left, right]), palette=False)


def _choose(browser: Browser, label: str, option: str) -> None:
    """Choose in one of the viewer's lists."""
    found = f"[...document.querySelectorAll('label')].find(e => e.textContent === {json.dumps(label)})"
    browser.wait(found)
    browser.run(f"document.getElementById({found}.htmlFor).click()")
    at = f"[...document.querySelectorAll('[role=option]')].filter(e => e.textContent.trim() === {json.dumps(option)} "
    at += "&& e.getBoundingClientRect().width)[0]"
    browser.wait(at)
    browser.run(f"{at}.click()")
    time.sleep(0.5)


def init_click() -> None:
    """The page of `kinefit init --click`, in which the joints of one camera were clicked."""
    demo = results.synthetic_demo()
    motion, seen = kinefit.read_motion(demo / "motion.npz"), load_observations(read_take(demo / "take" / "take.toml"))
    assert seen.rig is not None
    words = ("init", demo / "take", "--out", results.folder("clicks") / "take.toml", "--force", "--click", "--step", 20)
    with served(*words, "--no-browser") as address, Browser((1200, 760)) as browser:
        browser.open(address)
        browser.wait("typeof asked === 'object' && asked && view().scale > 0")
        landmarks = motion.body.landmarks
        for joint in browser.run("asked.joints"):
            if joint in landmarks.names:
                x = motion.positions(landmarks.select((joint,)))[20, 0]
                u, v = seen.rig[browser.run("camera")].project(x)
                browser.run(f"joint = {json.dumps(joint)}")
                left, top, scale, x0, y0 = browser.run(
                    "(b => [b.x, b.y, view().scale, view().x, view().y])(canvas.getBoundingClientRect())"
                )
                browser.click(left + x0 + (u + 0.5) * scale, top + y0 + (v + 0.5) * scale)
        time.sleep(1.0)
        results.save("init_click.png", browser.image())


def app() -> None:
    """The result page of `kinefit app` with the demo's result, at a moment on the beam."""
    recording = results.folder("app") / "balancing"
    if not recording.exists():
        recording.symlink_to(results.demo() / "take")
    words = ("app", recording.parent, "--port", 0, "--no-browser")
    with served(*words) as address, Browser((1300, 1600)) as browser:
        browser.open(address)
        _press(browser, "Show faces")  # the recording hides them itself
        _wait_for(browser, "Open a recording")
        browser.open(f"{address}result?{urlencode({'path': recording / 'take.toml', 'folder': results.demo()})}")
        _wait_for(browser, "Corrections")
        time.sleep(10.0)
        left, top = browser.run("(b => [b.x, b.y])(document.querySelector('iframe').getBoundingClientRect())")
        browser.click(left + 265, top + 75)  # close the viewer's note on slow rendering
        x, y, width = browser.run(
            "(b => [b.x, b.y + b.height / 2, b.width])(document.querySelector('.q-slider').getBoundingClientRect())"
        )
        browser.click(x + 0.4 * width, y)
        time.sleep(10.0)
        results.save("app.png", browser.image())


def _wait_for(browser: Browser, text: str) -> None:
    browser.wait(f"document.body.innerText.includes({json.dumps(text)})")


def _press(browser: Browser, said: str) -> None:
    """Press the button that says so."""
    found = f"[...document.querySelectorAll('button')].find(e => e.textContent.includes({json.dumps(said)}))"
    browser.wait(found)
    browser.run(f"{found}.click()")
