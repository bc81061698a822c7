"""Several people, one camera, depth cameras."""
