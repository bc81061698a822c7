"""Recordings of ROS 2 (MCAP, extra `ros`): depth, images, cameras."""
