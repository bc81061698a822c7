"""Real."""
def run(quick): pass
