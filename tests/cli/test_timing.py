import pathlib
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import pytest

from vojax.cli import _timing
from vojax.cli._timing import FrameClock


def test_frames_with_compilation_are_told_apart(monkeypatch):
    # The clock is read at the start and after each turn; turns 0 and 3 compile.
    times = iter([10.0, 15.0, 15.5, 16.5, 19.0, 19.75])
    monkeypatch.setattr(_timing.time, "perf_counter", lambda: next(times))
    with FrameClock() as clock:
        for turn in range(5):
            if turn in (0, 3):
                jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 1.0)
            clock.tick()
    assert (clock.frames, clock.compiling_frames) == (5, 2)
    assert clock.total_seconds == pytest.approx(9.75)
    assert clock.frames_per_second == pytest.approx(3 / 2.25)
    assert clock.compile_seconds == pytest.approx(7.5 - 2 * 0.75)
    # The two add up: all frames at the steady rate, and the compilation.
    assert clock.frames / clock.frames_per_second + clock.compile_seconds == pytest.approx(clock.total_seconds)


def test_jax_reports_a_compilation_once():
    program = jax.jit(lambda x: jnp.sin(x) * 3.25 + 0.125)
    x = jnp.ones(17)
    with FrameClock() as clock:
        program(x).block_until_ready()
        clock.tick()
        program(x).block_until_ready()
        clock.tick()
    assert clock.compiling_frames == 1
    assert clock.compile_seconds > 0
    # Outside the context it listens no longer.
    jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 1.0)
    clock.tick()
    assert clock.compiling_frames == 1


def test_no_steady_frame_no_rate():
    with FrameClock() as clock:
        jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 1.0)
        clock.tick()
    assert clock.frames_per_second is None
    assert clock.compile_seconds == pytest.approx(clock.total_seconds)


def test_age_and_memory_of_a_process():
    path = pathlib.Path(_timing.__file__)
    code = (
        "import importlib.util, time\n"
        "time.sleep(0.5)\n"
        f"spec = importlib.util.spec_from_file_location('timing', {str(path)!r})\n"
        "timing = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(timing)\n"
        "before = timing.peak_memory_mb()\n"
        "block = b'x' * 80_000_000\n"
        "print(timing.seconds_since_process_start(), timing.peak_memory_mb() - before)\n"
    )
    started = time.perf_counter()
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    elapsed = time.perf_counter() - started
    age, grown = map(float, result.stdout.split())
    assert age <= elapsed + 0.05  # the kernel counts in hundredths
    if sys.platform == "linux":
        assert age >= 0.5
    assert 60 < grown < 100
