"""What every single-view camera model offers, and the halves of it that models share."""

import abc
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Bool, Float

from ._components import bearing_on_plane, onto_cone


@runtime_checkable
class Camera(Protocol):
    """A central camera: a map between points around it and pixels (+z forward, integer pixel centres)."""

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise: `(u, v)` in pixels."""
        ...

    def project(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Project points of the camera frame to pixels."""
        ...

    def in_domain(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Mask of the points that the model can image: where no two rays share a pixel."""
        ...

    def unproject(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit bearings, in the camera frame, of pixels."""
        ...

    def normalized(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Undistorted coordinates, on the plane z = 1, of pixels."""
        ...


class CentralCamera(eqx.Module):
    """A camera written elementwise over components, offered over arrays of points and pixels too."""

    @abc.abstractmethod
    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise.

        Args:
            x: Camera-frame coordinate to the right, an array of any shape.
            y: Camera-frame coordinate downwards.
            z: Camera-frame depth.

        Returns:
            Pixel coordinates u and v.
        """

    @abc.abstractmethod
    def in_domain_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> Bool[Array, "*shape"]:
        """Mask of the points, given by components, that the model can image, elementwise."""

    @abc.abstractmethod
    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""

    @abc.abstractmethod
    def normalized_xy(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Undistorted coordinates on the plane z = 1 of pixels given by components, elementwise."""

    def project(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Project points of the camera frame to pixels."""
        points = jnp.asarray(points_cam)
        return jnp.stack(self.project_xyz(points[..., 0], points[..., 1], points[..., 2]), axis=-1)

    def in_domain(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Mask of the points that the model can image: where no two rays share a pixel.

        It knows no image size. Outside, `project` is finite and means nothing.
        """
        points = jnp.asarray(points_cam)
        return self.in_domain_xyz(points[..., 0], points[..., 1], points[..., 2])

    def unproject(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit bearings, in the camera frame, of pixels."""
        pixels = jnp.asarray(pixels)
        return jnp.stack(self.unproject_uv(pixels[..., 0], pixels[..., 1]), axis=-1)

    def normalized(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Undistorted coordinates of pixels on the plane z = 1.

        A ray 89.4 degrees and more from the axis, and one that points backwards, counts as one at 89.4 degrees in its
        own direction: the plane ends there. `unproject` gives what it really is.
        """
        pixels = jnp.asarray(pixels)
        return jnp.stack(self.normalized_xy(pixels[..., 0], pixels[..., 1]), axis=-1)


class PlaneCamera(CentralCamera):
    """A camera whose rays all cross the plane z = 1."""

    def unproject_uv(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Unit bearings of pixels given by components, elementwise."""
        return bearing_on_plane(*self.normalized_xy(u, v))


class WideCamera(CentralCamera):
    """A camera that may see sideways and behind itself."""

    def normalized_xy(
        self, u: Float[ArrayLike, "*shape"], v: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Undistorted coordinates on the plane z = 1 of pixels given by components, elementwise; see `normalized`."""
        return onto_cone(*self.unproject_uv(u, v))
