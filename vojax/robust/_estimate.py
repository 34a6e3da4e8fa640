"""What every robust estimator returns."""

from typing import Generic, TypeVar

import equinox as eqx

from vojax._result import Result
from vojax._types import Array, Bool, Float, Int

Model = TypeVar("Model")


class Estimate(eqx.Module, Generic[Model]):
    """A robust estimate.

    Attributes:
        model: The estimated model; see the estimator for frames and units.
        inliers: Observations that agree with the model.
        num_inliers: How many.
        score: Σ min(e²/threshold², 1) over the observations: 0 is perfect.
        num_hypotheses: Minimal samples drawn.
        covariance: Of the model's tangent, from the inliers and the stated noise; zero where it failed.
        result: How it ended, a code with a sentence: `Result[estimate.result]`.
    """

    model: Model
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    score: Float[Array, ""]
    num_hypotheses: Int[Array, ""]
    covariance: Float[Array, "t t"]
    result: Result
