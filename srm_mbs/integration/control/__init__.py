"""Step-size control, placement of steps around singular configurations, and guards."""
