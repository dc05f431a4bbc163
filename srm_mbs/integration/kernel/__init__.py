"""Bridge to the compiled kernel: data handed over, runs, dense output."""
