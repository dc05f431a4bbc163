"""SDF (Simulation Description Format)."""
