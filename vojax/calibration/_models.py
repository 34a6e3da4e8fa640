"""What calibration has to know of a camera model: its unknowns, and where to start."""

import dataclasses
import inspect
from typing import Any

import jax
import jax.numpy as jnp

from vojax import cameras
from vojax._types import Array, Float

Free = tuple[tuple[str, ...], ...]

# What stays as it is unless `free` names it: what an ordinary camera does not have, what the model's own parameters can
# hardly be told from, and the shear `e`, which together with `d` is a rotation about the axis, as every pose has one.
FIXED_BY_DEFAULT = {"Pinhole": ("skew",), "Unified": ("k1", "k2", "p1", "p2"), "Scaramuzza": ("e",)}
MODELS = {
    "pinhole": cameras.Pinhole,
    "brown-conrady": cameras.BrownConrady,
    "kannala-brandt": cameras.KannalaBrandt,
    "unified": cameras.Unified,
    "extended-unified": cameras.ExtendedUnified,
    "double-sphere": cameras.DoubleSphere,
    "scaramuzza": cameras.Scaramuzza,
    "spherical": cameras.Spherical,
}


def template_of(model: Any, dtype: Any) -> tuple[Any, bool]:
    """A camera of the model, and whether its values are a start given by the caller.

    Args:
        model: A camera class, or a camera.
        dtype: Of its parameters.

    Raises:
        ValueError: If it is neither, or a class that needs more than focal lengths and a principal point.
    """
    if inspect.isclass(model):
        try:
            camera, given = start_of_class(model, jnp.asarray([1.0, 1.0, 0.0, 0.0], dtype)), False
        except (TypeError, AttributeError):
            raise ValueError(
                f"model is {model.__name__}, which cannot be made from focal lengths and a principal point: give a "
                "camera to start from"
            ) from None
    else:
        camera, given = model, True
    if not isinstance(camera, cameras.Camera) or not dataclasses.is_dataclass(camera):
        raise ValueError(f"model is {model!r}: expected a camera class such as BrownConrady, or a camera")
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), camera), given


def start_of_class(model: type, guess: Float[Array, "4"]) -> Any:
    """A camera of the class without lens distortion, at (fx, fy, cx, cy)."""
    fx, fy, cx, cy = guess
    if model is cameras.Scaramuzza:
        # The stereographic projection, ρ = 2 f tan(θ/2): between a pinhole and an equidistant lens.
        focal = jnp.sqrt(fx * fy)
        return cameras.Scaramuzza(cx=cx, cy=cy, a0=focal, a2=-0.25 / focal)
    shape: dict[str, float] = {}
    if model is cameras.Unified:
        shape = {"xi": 1.0}
        fx, fy = 2.0 * fx, 2.0 * fy  # on the axis pixels move by f / (1 + ξ)
    elif model is cameras.ExtendedUnified:
        shape = {"alpha": 0.5, "beta": 1.0}
    elif model is cameras.DoubleSphere:
        shape = {"xi": 0.0, "alpha": 0.5}
    return model(fx=fx, fy=fy, cx=cx, cy=cy, **{key: jnp.asarray(value, fx.dtype) for key, value in shape.items()})


def start_camera(template: Any, guess: Float[Array, "4"]) -> Any:
    """The template's model without lens distortion, at (fx, fy, cx, cy)."""
    return start_of_class(type(template), guess)


def all_parameters(camera: Any) -> tuple[str, ...]:
    """Names of all parameters; entries of tuples by number, as `higher.0`."""
    names: list[str] = []
    for field in dataclasses.fields(camera):
        value = getattr(camera, field.name)
        names += [f"{field.name}.{i}" for i in range(len(value))] if isinstance(value, tuple) else [field.name]
    return tuple(names)


def free_parameters(camera: Any, free: Any) -> Free:
    """Unknowns as groups of tied parameters.

    Args:
        camera: Of the model.
        free: Names of parameters, or tuples of names that keep their differences; None for the usual ones.

    Raises:
        ValueError: If a parameter does not exist or stands twice.
    """
    known = all_parameters(camera)
    if free is None:
        fixed = FIXED_BY_DEFAULT.get(type(camera).__name__, ())
        return tuple((name,) for name in known if name not in fixed)
    groups = tuple((entry,) if isinstance(entry, str) else tuple(entry) for entry in free)
    names = [name for group in groups for name in group]
    for name in names:
        if name not in known:
            raise ValueError(
                f"free names {name!r}, which {type(camera).__name__} does not have: it has {', '.join(known)}"
            )
    if len(set(names)) < len(names):
        raise ValueError(f"free names {', '.join(names)}: expected each once")
    return groups


def parameter_names(free: Free) -> tuple[str, ...]:
    """A name for each unknown."""
    return tuple(" = ".join(group) for group in free)
