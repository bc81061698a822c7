"""What of a body each camera sees: visibility, occlusion, assignment of pixels to people."""
