"""Servers that kinefit opens: who may connect, what their pages may do, and the thread that serves them."""

TOKEN_VARIABLE = "KINEFIT_TOKEN"
"""Environment variable from which commands take the token of their servers."""
