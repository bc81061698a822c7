"""Check the inputs of a take: calibration, keypoints, clocks, scale and vertical of the world.

`checks.check_keypoints` runs all checks, `quick.input_findings` those that `track` always runs.
"""
