"""The descent that optimistix' loop takes its steps from."""

from typing import Any

import jax.numpy as jnp
import optimistix as optx

from ._bundle_factors import FactorBlock
from ._bundle_layout import BundleLayout
from ._bundle_pcg import solve_iteratively
from ._bundle_schur import BundleSystem, normal_equations, solve
from ._bundle_state import zero_like_unknowns

# Tolerance and most iterations of conjugate gradients: a step need not be exact, a derivative must.
STEP_ACCURACY = (1e-2, 300)
DERIVATIVE_ACCURACY = (1e-12, 5000)


class SchurDescent(optx.AbstractDescent):
    """Levenberg–Marquardt step of a bundle: landmarks eliminated, cameras solved, landmarks substituted back.

    The cameras' system is factored, or with `iterative` solved by conjugate gradients without being formed.
    """

    layout: BundleLayout
    iterative: bool = False

    def init(self, y: Any, f_info_struct: Any) -> BundleSystem:
        """Zeros of the right shape."""
        del f_info_struct
        dtype = y.landmarks.dtype
        c, k = self.layout.columns.shape
        _, landmarks = zero_like_unknowns(self.layout, dtype)
        zeros = lambda *shape: jnp.zeros(shape, dtype)  # noqa: E731
        factors = (columns.shape for columns in self.layout.factor_columns)
        return BundleSystem(
            zeros(c, k, k),
            zeros(c, k),
            zeros(3, *landmarks.shape),
            landmarks,
            zeros(k, 3, self.layout.slots),
            tuple(FactorBlock(zeros(f, q, q), zeros(f, q)) for f, q in factors),
        )

    def query(self, y: Any, f_info: Any, state: BundleSystem) -> BundleSystem:
        """Form the blocks at a newly accepted point."""
        del y, state
        return normal_equations(f_info.jac.blocks, f_info.jac.data, self.layout)

    def step(self, step_size: Any, state: BundleSystem) -> tuple[Any, optx.RESULTS]:
        """Solve for the step at damping 1/step_size."""
        damped = state.damped(1.0 / step_size)
        if self.iterative:
            return solve_iteratively(damped, self.layout, *STEP_ACCURACY), optx.RESULTS.successful
        return solve(damped, self.layout), optx.RESULTS.successful
