"""What a stranger's machine and a stranger's files do to kinefit: `python -m benchmarks.product [PART ...]`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "start": "how long a user waits: first and later starts, the whole track of the demo's recording",
    "install": "what a fresh installation takes on disk, with the viewer and without",
    "product_doors": "wrong and unusual inputs by a user's commands: right, said or unsaid",
    "window": "kinefit app in a browser: first image, answers while it computes, cost, typed words",
    "window_kills": "kinefit app killed while it computes a session of 20 takes",
    "report_pages": "pages of the demo's report in print",
    "long": "long takes: memory by length, going on after a kill, the page of an hour",
    "live": "live sessions of the balancing trial: latency, an hour's memory and drift",
    "speed": "frames a second by sensor and number of cameras",
    "setups": "which sensor set-up is how exact, simulated: cameras by number, and sensors",
    "batch": "many takes: two workers against one, what Dask adds to a take, equal after a kill",
    "formats": "every format, read back by a program that others wrote",
    "coverage": "how much of the source the tests run",
    "fuzz": "every reader on damaged files: a typed error or a valid result, soon and in little memory",
}

if __name__ == "__main__":
    run_parts(PARTS)
