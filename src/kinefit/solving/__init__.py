"""Solve for states from rows: normal equations, least squares, constraints, sequences, assignment."""
