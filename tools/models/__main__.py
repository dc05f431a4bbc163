"""Write every model."""

from __future__ import annotations

from pathlib import Path

from tools.models import made

ROOT = Path(__file__).parents[2]

if __name__ == "__main__":
    for name, make in made().items():
        urdf, description = make()
        if urdf:  # a linkage needs none
            (ROOT / "urdf" / f"{name}.urdf").write_text(urdf, encoding="utf-8")
        (ROOT / "models" / f"{name}.toml").write_text(description, encoding="utf-8")
