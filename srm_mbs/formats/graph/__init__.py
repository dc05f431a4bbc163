"""Graphs of joints with loops, cut into a spanning tree and closures."""
