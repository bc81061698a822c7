"""Hands and heads."""
