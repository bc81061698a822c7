"""Every figure of several people in view: `python -m benchmarks.people`; some parts: `... people people_simulated`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "people_real": "two people in four real videos, by the built-in detector",
    "people_detectors": "one detector and two, on the real trial",
    "people_bias": "bias by direction of view, found in the take and out of other recordings",
    "people_turned": "a camera whose calibration is turned, on the real trial",
    "people_one_camera": "one person before one camera, against markers",
    "people_depth": "one person before real depth cameras",
    "people_return": "people who leave and come back elsewhere, simulated and in four real videos",
    "people_simulated": "people who cross, shake hands, hide each other, leave and come back",
    "people_rough": "the same as detectors see people in real rooms: missed, doubled, merged, behind furniture",
}

if __name__ == "__main__":
    run_parts(PARTS)
