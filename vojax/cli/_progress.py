"""Progress of a run: a live bar on a terminal, a few plain lines elsewhere."""

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

_LINES = 10


class FrameProgress:
    """Counts frames; use as a context around the loop.

    Args:
        console: Where to draw.
        frames: How many there will be.
    """

    def __init__(self, console: Console, frames: int):
        self._console = console
        self._frames = frames
        self._done = 0
        self._started = 0.0
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TextColumn("{task.fields[detail]}"),
                TimeRemainingColumn(compact=True),
                console=console,
                expand=True,
            )

    def __enter__(self) -> "FrameProgress":
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("frames", total=self._frames, detail="compiling …")
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, inliers: int, bridged: bool) -> None:
        """Report a finished frame."""
        now = time.perf_counter()
        self._done += 1
        if self._done <= 2:  # Compilation falls into the first two.
            self._started = now
            rate = ""
        else:
            rate = f"{(self._done - 2) / max(now - self._started, 1e-9):.1f} frames/s · "
        detail = f"{rate}{'not tracked' if bridged else f'{inliers} inliers'}"
        if self._bar is not None:
            self._bar.update(self._task, advance=1, detail="compiling …" if self._done == 1 else detail)
        elif self._done * _LINES // self._frames > (self._done - 1) * _LINES // self._frames:
            line = f"frame {self._done}/{self._frames} · {detail}"
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)
