"""Results as files: each written whole or not at all."""

from kinefit.exporters.c3d_file import write_c3d, write_markers
from kinefit.exporters.interchange import write_mcap, write_nwb, write_rrd
from kinefit.exporters.motion_file import write_jsonl, write_motion
from kinefit.exporters.opensim import write_forces, write_mot, write_osim, write_trc
from kinefit.exporters.pictures.overlay import (
    depth_picture,
    draw_overlay,
    write_depth_overlay,
    write_montage,
    write_overlay,
)
from kinefit.exporters.report.angles import range_changes
from kinefit.exporters.report.report import write_report
from kinefit.exporters.skeletons.bvh import write_bvh, write_x3d
from kinefit.exporters.skeletons.fbx import write_fbx
from kinefit.exporters.skeletons.glb import write_glb, write_usd
from kinefit.exporters.skeletons.retarget import write_character
from kinefit.exporters.tables import tables, write_csv, write_parquet

__all__ = [
    "depth_picture", "draw_overlay", "range_changes", "tables", "write_bvh", "write_c3d", "write_character",
    "write_csv", "write_depth_overlay", "write_fbx", "write_forces", "write_glb", "write_jsonl", "write_markers",
    "write_mcap",
    "write_montage", "write_mot", "write_motion", "write_nwb", "write_osim", "write_overlay", "write_parquet",
    "write_report", "write_rrd", "write_trc", "write_usd", "write_x3d",
]  # fmt: skip
