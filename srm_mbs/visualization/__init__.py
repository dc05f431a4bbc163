"""Animations and plots of runs."""
