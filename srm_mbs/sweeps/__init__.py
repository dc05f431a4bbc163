"""Sweeps: one mechanism, or a family of them, simulated many times on any executor."""
