"""Intrinsics by name: which parameters of a camera are solved for, and cameras with these increased."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx

from vojax._types import Array

# Names of attributes of the camera that are one unknown: they change by the same increment.
Tied = tuple[str, ...]


def get_attribute(tree: Any, path: str) -> Any:
    """Attribute by a dotted path; a number is a place in a tuple."""
    step = lambda node, name: node[int(name)] if name.isdigit() else getattr(node, name)  # noqa: E731
    return functools.reduce(step, path.split("."), tree)


def add_to_camera(camera: Any, free: Sequence[Tied], increments: Sequence[Array] | Array) -> Any:
    """The camera with each group of tied attributes increased."""
    for names, increment in zip(free, increments, strict=True):
        for name in names:
            camera = eqx.tree_at(
                lambda tree, name=name: get_attribute(tree, name), camera, get_attribute(camera, name) + increment
            )
    return camera
