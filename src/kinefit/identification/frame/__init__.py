"""Who is who in one frame."""
