"""What every solver returns."""

from typing import Generic, TypeVar

import equinox as eqx

from vojax._types import Array, Bool

Model = TypeVar("Model")


class Candidates(eqx.Module, Generic[Model]):
    """A fixed number of candidate models, of which some are solutions.

    Attributes:
        models: Pytree with a leading slot axis. Slots that hold no solution hold finite placeholders.
        valid: True for the slots that solve the problem.
    """

    models: Model
    valid: Bool[Array, "*batch s"]
