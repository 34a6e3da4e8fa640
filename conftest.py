"""For tests and doctests alike."""

import gc

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def forget_compiled_programs():
    """Drop what a module compiled: every program maps memory, and a process may have only so many maps (65,530).

    Beyond, XLA does not fail but crashes.
    """
    yield
    jax.clear_caches()
    gc.collect()
