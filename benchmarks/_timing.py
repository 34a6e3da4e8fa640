"""Timing for all benchmarks: compile time apart, medians and minima of repeated calls, versions beside them."""

import os
import platform
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds."""

    compile: float
    median: float
    best: float


def time_jitted(function: Callable[..., Any], *arguments: Any, seconds: float = 2.0) -> Timing:
    """Time a function under jit: the first call apart, then as many as fit into `seconds` (at least five)."""
    jitted = jax.jit(function)
    start = time.perf_counter()
    jax.block_until_ready(jitted(*arguments))
    compile_seconds = time.perf_counter() - start
    return Timing(compile_seconds, *time_calls(lambda: jax.block_until_ready(jitted(*arguments)), seconds))


def time_calls(call: Callable[[], Any], seconds: float = 2.0) -> tuple[float, float]:
    """Median and minimum of repeated calls."""
    call()
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < 5 or time.perf_counter() - begin < seconds:
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times)), min(times)


def describe_machine() -> str:
    """One line: processor, cores, versions."""
    model = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo") as lines:
            model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    device = jax.devices()[0]
    return (
        f"{model}, {os.cpu_count()} cores, device {device.platform}; Python {platform.python_version()}, "
        f"jax {jax.__version__}"
    )
