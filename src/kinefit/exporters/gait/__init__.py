"""The gait record: strides and steps of one person's walks put together, as tables and as a page."""
