"""Every figure of region-based tracking: `python -m benchmarks.regions`; some parts: `... regions regions_cat`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "regions_cat": "a real hand-held object before clutter, followed by its mesh",
    "regions_body10": "a rendered body of ten parts in colour and depth",
    "regions_rendered": "rendered objects in the manner of RBOT: moving light, noise, an occluder, larger steps",
    "regions_people": "the balancing trial by colours alone, beside keypoints, and by the paper's own recipe",
    "regions_gear": "a rendered cyclist in a lab and a snowboarder outdoors, with closures and without",
    "regions_few": "the cyclist by one camera and two, blurred, with closures and without",
    "regions_jumps": "jumps, turns, riders who rise, seconds of pedalling, at 100 Hz by four and seven cameras",
    "regions_speed": "time of a frame of a whole person",
}

if __name__ == "__main__":
    run_parts(PARTS)
