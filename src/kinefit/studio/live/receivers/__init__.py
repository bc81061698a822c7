"""Receivers of a live session's poses: WebSocket and page, VMC over OSC, LSL, JSON lines."""
