"""Every figure of closed chains: `python -m benchmarks.closures`; some parts: `... closures closures_mobility`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "closures_planar": "the planar pedal example: closed form, explicit chain, soft and hard closures",
    "closures_printed": "pedal and snowboarder by colours, closed by the paper's equations (18) and (19)",
    "closures_mobility": "Gruebler's count, rank and mobility of the catalogue's bodies",
    "closures_people": "a cyclist and a snowboarder, simulated, with closures and without",
    "closures_gear": "dimensions of gear that are estimated",
    "closures_sports": "a rower, a lifter and a golfer, with a dimension of their gear estimated",
    "closures_swing": "a real golf swing by markers: how the club is held",
    "closures_contacts": "feet that leave the ground and come back",
}

if __name__ == "__main__":
    run_parts(PARTS)
