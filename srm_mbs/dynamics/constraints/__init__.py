"""Closure rows and their linear algebra: projection, rank, structure, mobility, reactions."""
