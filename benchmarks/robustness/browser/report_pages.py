"""Pages of the demo's report in print: Chromium without a window writes the PDF."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from benchmarks.figures import LEFT_OUT, NotMeasured, figure, quick
from kinefit.cli import main


def run() -> None:
    """Print the figure."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None or quick():
        raise NotMeasured(LEFT_OUT if quick() else "no chromium here")
    with tempfile.TemporaryDirectory() as work:
        main(["demo", "--out", work], standalone_mode=False)
        pdf = Path(work) / "report.pdf"
        page = (Path(work) / "report.html").as_uri()
        options = ["--headless", "--no-sandbox", f"--print-to-pdf={pdf}", "--virtual-time-budget=20000", page]
        subprocess.run([browser, *options], check=True, capture_output=True)
        figure("report_pages", len(re.findall(rb"/Type\s*/Page[^s]", pdf.read_bytes())), "pages", "<= 8")
