"""Longer tests (marker ``stress``): random mechanisms and starts, long runs, faults, mutations."""
