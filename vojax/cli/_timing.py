"""Clocks of a run: since the process started, per frame, and how much of it was compilation."""

import contextlib
import math
import os
import sys
import time
from collections.abc import Iterator

_IMPORTED = time.perf_counter()
_COMPILED = "/jax/core/compile/backend_compile_duration"


def seconds_since_process_start() -> float:
    """Age of this process in seconds; since the import of this module where the system does not tell."""
    since_import = time.perf_counter() - _IMPORTED
    try:
        with open("/proc/self/stat", encoding="utf-8", errors="replace") as file:
            # The command's name is in brackets and may hold spaces; the start is field 22, in ticks since boot.
            started = float(file.read().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (OSError, ValueError, IndexError, AttributeError):
        return since_import
    return age if age >= since_import else since_import


def peak_memory_mb() -> float | None:
    """Largest resident size of this process so far, MB of 10^6 bytes; None on systems that do not count it."""
    try:
        # Where there is this file it is the better source: the resource usage includes that of the parent at its fork.
        with open("/proc/self/status", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024 / 1e6
    except (OSError, ValueError, IndexError):
        pass
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class FrameClock:
    """Wall-clock time of each turn of a loop and of its stages, and whether JAX compiled something in it.

    A program that comes out of the persistent cache counts as compiled too. Both threads count: reading ahead may
    compile as well. Use as a context around the loop.
    """

    def __init__(self):
        self._seconds: list[float] = []
        self._compiling: list[bool] = []
        self._programs = 0
        self._programs_before = 0
        self._last = 0.0
        self._stages: dict[str, list[float]] = {}
        self._turn: dict[str, float] = {}

    def __enter__(self) -> "FrameClock":
        import jax

        jax.monitoring.register_event_duration_secs_listener(self._listen)
        self._last = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        import jax

        jax.monitoring.unregister_event_duration_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        self._programs += event == _COMPILED

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside as a stage of this turn."""
        started = time.perf_counter()
        yield
        self.add(name, time.perf_counter() - started)

    def add(self, stage: str, seconds: float) -> None:
        """Count time that was taken elsewhere, such as in another thread, as a stage of this turn."""
        self._turn[stage] = self._turn.get(stage, 0.0) + seconds

    def tick(self) -> None:
        """End a turn of the loop, and begin the next."""
        now, programs = time.perf_counter(), self._programs
        for name in self._turn:
            self._stages.setdefault(name, [0.0] * len(self._seconds))
        for name, seconds in self._stages.items():
            seconds.append(self._turn.get(name, 0.0))
        self._turn = {}
        self._seconds.append(now - self._last)
        self._compiling.append(programs > self._programs_before)
        self._last, self._programs_before = now, programs

    @property
    def frames(self) -> int:
        """Turns so far."""
        return len(self._seconds)

    @property
    def total_seconds(self) -> float:
        """Wall clock of all turns."""
        return sum(self._seconds)

    @property
    def compiling_frames(self) -> int:
        """Turns in which something was compiled."""
        return sum(self._compiling)

    @property
    def frames_per_second(self) -> float | None:
        """Rate over the turns without compilation; None where there was none such."""
        steady = self._steady()
        return len(steady) / sum(steady) if steady else None

    @property
    def compile_seconds(self) -> float:
        """What the turns with compilation took beyond as many turns without."""
        steady = self._steady()
        usual = sum(steady) / len(steady) if steady else 0.0
        extra = [s - usual for s, compiling in zip(self._seconds, self._compiling, strict=True) if compiling]
        return max(0.0, sum(extra))

    @property
    def stages(self) -> dict[str, list[float]]:
        """Seconds of each stage, and of the whole as "frame", by turn; NaN in turns with compilation."""
        return {
            name: [math.nan if compiling else s for s, compiling in zip(seconds, self._compiling, strict=True)]
            for name, seconds in {**self._stages, "frame": self._seconds}.items()
        }

    def _steady(self) -> list[float]:
        return [s for s, compiling in zip(self._seconds, self._compiling, strict=True) if not compiling]
