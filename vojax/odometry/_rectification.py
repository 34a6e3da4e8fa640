"""Self-calibration of what rectification leaves behind: disparities that are wrong by a smooth function of the column.

A disparity that is a fraction of a pixel too small everywhere makes every depth, and so the whole trajectory, too
long. The error cannot be seen in one frame, nor averaged away over many points. It shows in motion: points at
different depths and columns disagree on how far the camera went. So the error d_true − d = a₀ + a₁ x², with x = (u −
c_x)/f_x, is estimated recursively beside the motion: each frame adds its information on (a₀, a₁), its own pose
marginalised.
"""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, Float
from vojax.cameras import RectifiedStereo

# A point is measured again in the next frame, so two frames share most of their evidence: each counts half.
_EVIDENCE_SHARE = 0.5
# Standard deviations of a0 and a1 before the first frame, px: a rectification is good to about a pixel at the edge.
_PRIOR_SIGMA_PX = (0.3, 1.0)


class DisparityCalibration(eqx.Module):
    """What is known of (a₀, a₁) of one pair or of several: a Gaussian in information form.

    Attributes:
        information: Inverse covariance, 1/px².
        vector: Information times the estimate, 1/px.
    """

    information: Float[Array, "m m"]
    vector: Float[Array, " m"]

    @classmethod
    def prior(cls, pairs: int = 1) -> "DisparityCalibration":
        """Before any frame: no error expected."""
        return cls(jnp.diag(jnp.array(_PRIOR_SIGMA_PX * pairs) ** -2), jnp.zeros(2 * pairs))

    def estimate(self) -> Float[Array, " m"]:
        """(a₀, a₁) in pixels, of one pair after the other."""
        if self.vector.shape[0] > 2:
            return jnp.linalg.solve(self.information, self.vector)
        (a, b), (_, d) = self.information
        determinant = a * d - b * b
        first, second = self.vector
        return jnp.stack([d * first - b * second, a * second - b * first]) / determinant

    def add(
        self, hessian: Float[Array, "p p"], gradient: Float[Array, " p"], at: Float[Array, " m"]
    ) -> "DisparityCalibration":
        """Add a frame's evidence.

        Args:
            hessian: Gauss–Newton matrix of the frame by pose (first six) and (a₀, a₁).
            gradient: Its right-hand side Jᵀr, at the optimal pose and `at`.
            at: The (a₀, a₁) that the frame was linearised at.
        """
        pose = hessian[:6, :6] + 1e-6 * jnp.diag(jnp.diag(hessian[:6, :6]))
        explained = jnp.linalg.solve(pose, jnp.concatenate([hessian[:6, 6:], gradient[:6, None]], axis=1))
        reduced = hessian[6:, 6:] - hessian[6:, :6] @ explained[:, :-1]
        rhs = gradient[6:] - hessian[6:, :6] @ explained[:, -1]
        usable = jnp.all(jnp.isfinite(reduced)) & jnp.all(jnp.isfinite(rhs))
        share = jnp.where(usable, _EVIDENCE_SHARE, 0.0)
        reduced, rhs = jnp.where(usable, reduced, 0.0), jnp.where(usable, rhs, 0.0)
        return DisparityCalibration(self.information + share * reduced, self.vector + share * (reduced @ at - rhs))


def disparity_terms(u_left: Float[Array, "*shape"], stereo: RectifiedStereo) -> tuple[Array, Array]:
    """The factors of a₀ and a₁: 1 and x²."""
    x = (u_left - stereo.camera.cx) / stereo.camera.fx
    return jnp.ones_like(x), x * x


def corrected(
    measurements: Float[Array, "*batch 3"], offsets: Float[Array, "2"], stereo: RectifiedStereo
) -> Float[Array, "*batch 3"]:
    """Stereo measurements (u_left, v, u_right) with the disparity error taken out."""
    constant, quadratic = disparity_terms(measurements[..., 0], stereo)
    shift = offsets[0] * constant + offsets[1] * quadratic
    return jnp.stack([measurements[..., 0], measurements[..., 1], measurements[..., 2] - shift], axis=-1)
