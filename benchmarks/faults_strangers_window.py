"""Strangers against the window in a real browser: `python -m benchmarks.faults_strangers_window`.

Each attack is tried on a recording, a report or a page that is made for it; all of it stays on this computer.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.figures import figure

_DRAWN = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def attacks() -> dict[str, bool]:
    """{attack: whether it was refused}; raises RuntimeError where there is no browser."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise RuntimeError("playwright is not installed") from error
    from tests.studio.app import attacking

    from kinefit.simulation import write_synthetic_take

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        raise RuntimeError("Chromium is not installed")
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        take = write_synthetic_take(Path(folder) / "drawn")
        (Path(folder) / "attacks").mkdir()
        browser = playwright.chromium.launch(executable_path=chromium, args=_DRAWN)
        try:
            return attacking.attacks(browser, take, Path(folder) / "attacks")
        finally:
            browser.close()


def run() -> None:
    try:
        refused = attacks()
    except RuntimeError as error:
        print(f"faults_strangers_browser: not measured ({error})")
        return
    for attack, is_refused in refused.items():
        print(f"  {'refused' if is_refused else 'SUCCEEDED'}: {attack}")
    figure("faults_strangers_browser", float(len(refused) - sum(refused.values())), "attacks", "== 0")


if __name__ == "__main__":
    run()
