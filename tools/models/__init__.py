"""Where the larger bundled mechanisms come from: geometry computed, URDF and TOML written.

    python -m tools.models

Run from a checkout; writes ``models/NAME.toml`` and ``urdf/NAME.urdf``.  A test checks that the
files are what this writes.
"""
