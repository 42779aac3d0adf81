"""Arguments of ``colmap-inertial view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from colmap_inertial.cli.command import ReadingCommand
from colmap_inertial.cli.terminal import show_view


@dataclass(frozen=True, kw_only=True)
class View(ReadingCommand):
    """Show a reconstruction in the browser, and measure in it.

    Points, cameras, gravity, a scale bar and the target are shown. OUT is what reconstruct or apply wrote, or a COLMAP
    model folder. A model without a scale is shown in its own units, without a grid in metres. Prints an address to
    open; Ctrl-C ends it. Needs the extra package [view].

    Example: colmap-inertial view out
    """

    out: Positional[Path]
    """What reconstruct or apply wrote, or a COLMAP model folder."""
    model: int | None = None
    """Number of the model, where there are several; the largest otherwise."""
    images: Path | None = None
    """Folder with the model's images, where they are not beside the model."""
    max_points: int = 400_000
    """Show no more points than this, evenly chosen."""
    port: int = 8080
    """Port to listen on; the next free one if it is taken, any free one for 0."""
    host: str = "127.0.0.1"
    """Address to listen on: this machine alone, or 0.0.0.0 for anyone on the network who knows the address shown."""

    def __post_init__(self) -> None:
        if self.max_points < 1:
            raise ValueError(f"max_points must be positive, not {self.max_points}")
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be from 0 to 65535, not {self.port}")

    def run(self) -> int:
        """Run the command; returns the exit code."""
        from colmap_inertial.tools.view.scene import load_scene
        from colmap_inertial.tools.view.server import require_viser, serve

        require_viser()
        scene = load_scene(self.out, model=self.model, images=self.images, max_points=self.max_points)
        serve(
            scene,
            host=self.host,
            port=self.port,
            ready=lambda url: self.tell(lambda: show_view(self.out, url, self.host), {"out": self.out, "url": url}),
        )
        return 0
