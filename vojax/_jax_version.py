"""Refusal of the one jaxlib release whose results cannot be trusted. Importing this module is the check."""

import re

import jaxlib

# 0.10.2 itself, its builds for an accelerator and its pre-releases; not 0.10.20.
_BROKEN = re.compile(r"0\.10\.2(?!\d)")


def check_jaxlib_version(version: str = jaxlib.__version__) -> None:
    """Raise if this jaxlib computes wrong results.

    On the CPU, jaxlib 0.10.2 returns wrong numbers without a warning: fused slice-update-reduce programs from about
    8,192 lanes on, and `arctan` from 50 elements on.

    Args:
        version: A version string; by default that of the installed jaxlib.

    Raises:
        ImportError: The version is 0.10.2.
    """
    if _BROKEN.match(version):
        raise ImportError(
            f"jaxlib {version} silently computes wrong results on the CPU (jax issues 39103 and 39352), so vojax does "
            "not run on it: install another with pip install 'jax>=0.10.1,!=0.10.2' 'jaxlib>=0.10.1,!=0.10.2'."
        )


check_jaxlib_version()
