"""Results as files: each written whole or not at all."""

from kinefit.exporters.bvh import write_bvh
from kinefit.exporters.c3d import write_c3d
from kinefit.exporters.depth_pictures import depth_picture, write_depth_overlay
from kinefit.exporters.glb import write_glb
from kinefit.exporters.motion_file import write_motion
from kinefit.exporters.opensim import write_mot, write_osim, write_trc
from kinefit.exporters.overlay import draw_overlay, write_montage, write_overlay
from kinefit.exporters.report import write_report
from kinefit.exporters.tables import tables, write_csv, write_parquet
from kinefit.exporters.usd import write_usd

__all__ = [
    "depth_picture", "draw_overlay", "tables", "write_bvh", "write_c3d", "write_csv", "write_depth_overlay",
    "write_glb", "write_montage", "write_mot", "write_motion", "write_osim", "write_overlay", "write_parquet",
    "write_report", "write_trc", "write_usd",
]  # fmt: skip
