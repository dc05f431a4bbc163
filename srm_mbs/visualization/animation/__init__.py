"""Animations with Meshcat: pages, pictures, videos, live views."""
