"""URDF with loops."""
