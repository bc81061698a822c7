"""Sensors that do not fit each other."""
def run(draws): pass
