"""Statics, linearisation, inverse dynamics, assembly modes, path following, summaries."""
