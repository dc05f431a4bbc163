"""The accuracy of a run: error estimate, conservation, certificate."""
