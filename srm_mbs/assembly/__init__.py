"""Consistent positions and velocities, and the diagnosis of mechanisms that do not close."""
