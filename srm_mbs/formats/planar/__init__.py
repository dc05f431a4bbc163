"""Planar linkages, by points and bars."""
