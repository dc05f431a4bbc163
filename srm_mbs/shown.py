"""What runs and prescribed motions have in common: they can be looked at."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from srm_mbs.notebook import Embedded


class Shown:
    """Base of :class:`~srm_mbs.Solution` and :class:`~srm_mbs.JointMotion`.

    Upward imports, made when something is to be seen.
    """

    def play(self, **options: Any) -> None:
        """Play it in the browser; see :func:`srm_mbs.playback.play`."""
        from srm_mbs.playback import play

        play(self, **options)  # type: ignore[arg-type]

    def show(self, **options: Any) -> Embedded:
        """What a notebook shows as the animation; see :func:`srm_mbs.notebook.show`."""
        from srm_mbs.notebook import show

        return show(self, **options)  # type: ignore[arg-type]

    def export_html(self, path: str | Path, **options: Any) -> None:
        """Write a self-contained page with the animation; see
        :func:`srm_mbs.playback.export_html`."""
        from srm_mbs.playback import export_html

        export_html(self, Path(path), **options)  # type: ignore[arg-type]

    def export_image(self, path: str | Path, **options: Any) -> None:
        """Write a picture at one time; see :func:`srm_mbs.rendering.export_image`."""
        from srm_mbs.rendering import export_image

        export_image(self, path, **options)  # type: ignore[arg-type]

    def export_video(self, path: str | Path, **options: Any) -> None:
        """Write a film; see :func:`srm_mbs.rendering.export_video`."""
        from srm_mbs.rendering import export_video

        export_video(self, path, **options)  # type: ignore[arg-type]
