"""The one driver, step-size control, placement around singular configurations, dense output."""
