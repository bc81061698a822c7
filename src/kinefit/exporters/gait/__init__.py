"""Gait: feet on plates, and the record of strides and steps of one person's walks, as tables and as a page."""
