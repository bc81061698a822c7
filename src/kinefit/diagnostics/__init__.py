"""What is wrong with the inputs of a take: cameras, keypoints, clocks, the world's scale and vertical.

`keypoints.check_keypoints` runs all of it, `quick.input_findings` what `track` always runs.
"""
