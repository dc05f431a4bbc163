"""Runs: options, the runner, results, storage, and the incremental simulator."""
