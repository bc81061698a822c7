"""Gait: events, strides, plates, the record of a person."""
