"""Where a body may be when nothing is known from before."""
