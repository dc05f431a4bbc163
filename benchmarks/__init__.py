"""Measurements behind the numbers in the documentation; run them from a checkout."""
