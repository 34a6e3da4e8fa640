"""What every single-view camera model offers."""

from typing import Protocol, runtime_checkable

from vojax._types import Array, ArrayLike, Float


@runtime_checkable
class Camera(Protocol):
    """A central camera: a map between points in front of it and pixels (+z forward, integer pixel centres)."""

    def project_xyz(
        self, x: Float[ArrayLike, "*shape"], y: Float[ArrayLike, "*shape"], z: Float[ArrayLike, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Project points given by components, elementwise: `(u, v)` in pixels."""
        ...

    def project(self, points_cam: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Project points of the camera frame to pixels."""
        ...

    def unproject(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit bearings, in the camera frame, of pixels."""
        ...

    def normalized(self, pixels: Float[ArrayLike, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Undistorted coordinates, on the plane z = 1, of pixels."""
        ...
