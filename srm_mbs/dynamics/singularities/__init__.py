"""Singular configurations: their local analysis, and the branches through them."""
