"""Mechanism data that checks itself: closures, forces, drives, laws; it computes no dynamics."""
