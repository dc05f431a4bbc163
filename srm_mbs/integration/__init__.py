"""Time integration: driver, events, dense output, breakpoints, singular passages."""
