"""Parameter sweeps: many runs, in parallel, with a journal."""
