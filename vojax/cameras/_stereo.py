"""A rectified stereo pair: two equal pinhole cameras, side by side along x."""

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float

from ._components import as_parameter, onto_plane
from ._pinhole import Pinhole

# A smaller disparity counts as this one: the point is finite, and farther than any pair can measure.
MIN_DISPARITY_PX = 1e-3


class RectifiedStereo(eqx.Module):
    """A rectified stereo pair; points live in the left camera's frame.

    Args:
        camera: Intrinsics of both cameras.
        baseline: Distance from the left to the right camera centre along +x, in metres.

    A measurement is `(u_left, v, u_right)` in pixels; disparity = u_left - u_right = fx * baseline / z.

    Degenerate input: projection as `Pinhole`. A disparity below 1e-3 px (zero and negative ones too) counts as 1e-3 px:
    the point is far but finite, and its gradient with respect to disparity is 0.

    Differentiability: both modes.

    Example:
        >>> import jax.numpy as jnp
        >>> stereo = RectifiedStereo(Pinhole(fx=500.0, fy=500.0, cx=320.0, cy=240.0), baseline=0.5)
        >>> stereo.project(jnp.array([1.0, 0.0, 2.0])).tolist()
        [570.0, 240.0, 445.0]
    """

    camera: Pinhole
    baseline: Float[Array, ""] = eqx.field(converter=as_parameter)

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise, to `(u_left, v, u_right)`."""
        x, y, z = jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)
        u_left, v = self.camera.project_xyz(x, y, z)
        xn_right, yn = onto_plane(x - self.baseline, y, z)
        return u_left, v, self.camera.fx * xn_right + self.camera.skew * yn + self.camera.cx

    def project(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Project points of the left camera frame to measurements `(u_left, v, u_right)`."""
        points = jnp.asarray(points_cam)
        return jnp.stack(self.project_xyz(points[..., 0], points[..., 1], points[..., 2]), axis=-1)

    def unproject_xyz(
        self,
        u_left: Float[ArrayLike, "*shape"],
        v: Float[ArrayLike, "*shape"],
        u_right: Float[ArrayLike, "*shape"],
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Points of the left camera frame from measurements given by components, elementwise."""
        u_left, u_right = jnp.asarray(u_left), jnp.asarray(u_right)
        disparity = u_left - u_right
        disparity = jnp.where(disparity > MIN_DISPARITY_PX, disparity, MIN_DISPARITY_PX)
        z = self.camera.fx * self.baseline / disparity
        xn, yn = self.camera.normalized_xy(u_left, v)
        return xn * z, yn * z, z

    def unproject(self, measurements: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Points of the left camera frame from measurements `(u_left, v, u_right)`."""
        measurements = jnp.asarray(measurements)
        return jnp.stack(self.unproject_xyz(measurements[..., 0], measurements[..., 1], measurements[..., 2]), axis=-1)
