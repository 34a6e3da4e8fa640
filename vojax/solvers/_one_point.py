"""Relative pose from one point on a vehicle that cannot slip sideways: one epipolar equation, one pose.

A vehicle with a fixed axle moves on a circle for as long as its steering stands still. Its heading turns by θ and the
axle moves along the chord, which is at θ/2 to the heading before and after. For a camera above the axle that leaves θ:

    t . (R f x g) = 0,     t = -(s, 0, c),  s = sin θ/2,  c = cos θ/2                                              (1)

in axes x to the right, y down, z in the direction of travel. Seen from halfway along the arc, the camera moves straight
ahead, and (1) is linear in c and s:

    c (g_y f_x - f_y g_x) + s (g_y f_z + f_y g_z) = 0.                                                             (2)

A camera that is mounted l ahead of the axle also swings sideways by 2 l s, and that length in metres is what the
direction of t can be compared with: if the half-way frame sees the camera go the part e of |t| to the left, it moved by

    |t| = 2 l s / e.                                                                                               (3)

References:
    D. Scaramuzza, F. Fraundorfer, R. Siegwart. Real-time monocular visual odometry for on-road vehicles with 1-point
        RANSAC. ICRA 2009.
    D. Scaramuzza, F. Fraundorfer, M. Pollefeys, R. Siegwart. Absolute scale in structure from motion from a single
        vehicle mounted camera by exploiting nonholonomic constraints. ICCV 2009.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vojax._numerics import cross3, dot3
from vojax._types import Array, ArrayLike, Bool, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._components import Components, Rows3, floor, vector3
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._upright_three_point import (
    NO_PARALLAX,
    UP,
    Data,
    arrays,
    choose_sign,
    placeholders,
    pose_components,
    turn,
    unit_components,
    upright_bearings,
    upright_motion,
)

FORWARD = np.array([0.0, 0.0, 1.0])


class ScaleFromTurn(NamedTuple):
    """Length of a translation that a turning vehicle reveals.

    Attributes:
        scale: What to multiply the translation by, in the unit of the lever arm; 0 where not valid.
        sensitivity: Relative error of `scale` per radian of error in the angles, large for gentle turns; 0 where not
            valid.
        valid: False where the vehicle does not turn or the pose contradicts the model.
    """

    scale: Float[Array, ""]
    sensitivity: Float[Array, ""]
    valid: Bool[Array, ""]


def vehicle_frame(forward: Float[Array, "3 *lanes"], up: Float[Array, "3 *lanes"]) -> tuple[Rows3, Array]:
    """Axes x right, y down, z forward of the vehicle; False where forward and up do not span a plane."""
    along, proper0 = unit_components(vector3(forward))
    (x, y, z), proper1 = unit_components(vector3(up))
    down = (-x, -y, -z)
    right, spanned = unit_components(cross3(down, along))
    sine = dot3(right, cross3(down, along))
    proper = proper0 & proper1 & spanned & (sine > 1e-3)
    return (tuple(right), down, cross3(right, down)), proper  # type: ignore[return-value]


def epipolar_coefficients(f: Components, g: Components) -> tuple[Array, Array]:
    """Coefficients of cosine and sine in (2)."""
    return g[1] * (f[0] - g[0]) - (f[1] - g[1]) * g[0], g[1] * f[2] + f[1] * g[2]


def _kernel(ray0: Array, ray1: Array, forward: Array, up: Array) -> tuple[Array, Array]:
    """The pose [1, 7, *lanes] and its validity [1, *lanes]."""
    eps = float(jnp.finfo(ray0.dtype).eps)
    axes, proper = vehicle_frame(forward, up)
    f, finite0 = upright_bearings(ray0[None], axes)
    g, finite1 = upright_bearings(ray1[None], axes)
    a, b = epipolar_coefficients(f, g)  # type: ignore[arg-type]
    size = jnp.sqrt(a * a + b * b)
    # Level with the camera, or symmetric about the middle of the arc, a point fits any angle.
    told = size > NO_PARALLAX * eps
    size = jnp.where(told, size, 1.0)
    side = jnp.where(b < 0, -1.0, 1.0).astype(b.dtype)  # cos θ/2 >= 0
    c, s = jnp.where(told, side * b / size, 1.0), jnp.where(told, -side * a / size, 0.0)
    ahead, behind = turn(c, s, f), turn(c, -s, g)
    normal = cross3(ahead, behind)
    blur = NO_PARALLAX * eps / size  # of the angle
    parallax = dot3(normal, normal) > (NO_PARALLAX * eps + blur) ** 2
    t = (jnp.zeros_like(c), jnp.zeros_like(c), jnp.ones_like(c))
    # Shapes [n, s, *lanes] with n = s = 1.
    points = [(x[0][None], x[1][None], x[2][None]) for x in (ahead, behind, normal)]
    sense, in_front = choose_sign(points[0], points[1], points[2], t, blur)
    valid = told & parallax & in_front & (proper & finite0 & finite1)[None]
    t = turn(c, s, tuple(sense * x for x in t))
    pose = pose_components(axes, axes, (c * c - s * s, 2.0 * c * s), t)
    return placeholders(pose, valid)


_solve = lanes_last(_kernel)


def _plane(forward: Array, up: Array) -> tuple[Array, Array]:
    """The direction of travel in the plane of motion, and the left."""
    left = jnp.cross(up, forward)
    size = jnp.sum(left * left)
    usable = size > 0
    left = jnp.where(usable, left / jnp.sqrt(jnp.where(usable, size, 1.0)), 0.0)
    return jnp.cross(left, up), left


def _equations(cam1_from_cam0: SE3, data: Data) -> Array:
    """The epipolar equation, no tilt, no climb, length one, and t at half the turn: arg(t²) = arg(R z) + arg(z)."""
    ray0, ray1, forward, up = data
    epipolar, across, length, up1 = upright_motion(cam1_from_cam0, (ray0[None], ray1[None], up, up))
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(forward)))
    ahead, left = _plane(forward / jnp.where(size > 0, size, 1.0), up1)
    t, turned = cam1_from_cam0.translation(), cam1_from_cam0.rotation() @ ahead
    t_ahead, t_left = jnp.sum(t * ahead), jnp.sum(t * left)
    half = 2.0 * t_ahead * t_left * jnp.sum(turned * ahead)
    half = half - (t_ahead * t_ahead - t_left * t_left) * jnp.sum(turned * left)
    return jnp.concatenate([epipolar, across, length, jnp.sum(t * up1)[None], half[None]])


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


_one_point = implicit(_candidates, _equations, perturb_camera, 6)


def one_point(
    ray0: Float[ArrayLike, "3"],
    ray1: Float[ArrayLike, "3"],
    forward: Float[ArrayLike, "3"] = FORWARD,
    up: Float[ArrayLike, "3"] = UP,
) -> Candidates[SE3]:
    """Find the motion along a circular arc from one correspondence.

    For a vehicle with a fixed axle and a camera above it, looking in any direction. Of a camera ahead of the axle by l,
    θ comes out wrong by about the share l / Z of itself, Z being the depth of the point.

    Args:
        ray0: Direction to the point in camera 0's frame, of any positive length.
        ray1: Direction to the same point in camera 1's frame.
        forward: The vehicle's direction of travel in the camera's frame; by default the optical axis, +z. Only its part
            across `up` matters.
        up: The normal of the floor in the camera's frame; by default -y.

    Returns:
        One slot of `cam1_from_cam0` with |t| = 1; `turn_angle` gives its θ. It is valid if the point is in front of
        both cameras (positive distances along the rays) for travel forwards or backwards, which the sign of t tells;
        else it holds the identity.

    Degenerate input: the slot is not valid if the point is at the height of the camera, which any turn explains; if
        turning on the spot explains the rays to rounding, as when standing still; for zero rays, a direction of travel
        along the vertical (within 1e-3 rad) and anything not finite.
    Differentiability: both modes, any order, in all arguments, by the implicit function theorem; zero where not valid.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.

    Example:
        >>> ray0 = jnp.array([0.5, 0.4, 2.0])
        >>> candidates = one_point(ray0, ray0 - jnp.array([0.0, 0.0, 1.0]))
        >>> bool(candidates.valid[0]), bool(jnp.abs(turn_angle(candidates.models)[0]) < 1e-6)
        (True, True)
    """
    return _one_point(arrays((3,), (ray0, ray1), (forward, up)))


def _half_turn(cam1_from_cam0: SE3, up: Array) -> tuple[Array, Array]:
    """Cosine and sine of half the change of heading, the cosine not negative."""
    wxyz = cam1_from_cam0.parameters()[..., :4]
    cosine, sine = wxyz[..., 0], -(wxyz[..., 1] * up[0] + wxyz[..., 2] * up[1] + wxyz[..., 3] * up[2])
    side = jnp.where(cosine < 0, -1.0, 1.0).astype(cosine.dtype)
    size = cosine * cosine + sine * sine
    usable = size > floor(size)
    size = jnp.sqrt(jnp.where(usable, size, 1.0))
    return jnp.where(usable, side * cosine / size, 1.0), jnp.where(usable, side * sine / size, 0.0)


def _unit(x: ArrayLike, dtype: jnp.dtype) -> Array:
    return jnp.stack(unit_components(vector3(jnp.asarray(x).astype(dtype)))[0])


def turn_angle(cam1_from_cam0: SE3, up: Float[ArrayLike, "3"] = UP) -> Float[Array, "*batch"]:
    """Change of heading of a vehicle in radians, in [-π, π], to the left positive.

    Args:
        cam1_from_cam0: Motion of the camera, in a batch if you like; of its rotation the part about `up` counts.
        up: The normal of the floor in the camera's frame.

    Differentiability: both modes, except at a half turn, where the angle jumps.
    """
    cosine, sine = _half_turn(cam1_from_cam0, _unit(up, cam1_from_cam0.parameters().dtype))
    return 2.0 * jnp.arctan2(sine, cosine)


def arc_motion(
    theta: float | Float[ArrayLike, ""], forward: Float[ArrayLike, "3"] = FORWARD, up: Float[ArrayLike, "3"] = UP
) -> SE3:
    """The motion `cam1_from_cam0`, |t| = 1, of a camera above the axle that travels forwards along an arc.

    Args:
        theta: Change of heading in radians, to the left.
        forward: The vehicle's direction of travel in the camera's frame.
        up: The normal of the floor in the camera's frame.

    Differentiability: both modes.
    """
    theta = jnp.asarray(theta)
    up = _unit(up, theta.dtype)
    ahead, left = _plane(_unit(forward, theta.dtype), up)
    cosine, sine = jnp.cos(0.5 * theta), jnp.sin(0.5 * theta)
    return SE3(jnp.concatenate([cosine[None], -sine * up, sine * left - cosine * ahead]))


def scale_from_turn(
    cam1_from_cam0: SE3,
    lever_arm: float | Float[ArrayLike, ""],
    forward: Float[ArrayLike, "3"] = FORWARD,
    up: Float[ArrayLike, "3"] = UP,
) -> ScaleFromTurn:
    """Find the length of a translation from the sideways swing of a camera mounted ahead of a fixed axle.

    The pose may come from any solver that does not assume the arc, such as `planar_two_point` or a five-point estimate;
    its tilt is ignored. A camera above the axle (`one_point`) sees no scale.

    Args:
        cam1_from_cam0: Motion between two images, its translation of any length, its sign fixed by cheirality.
        lever_arm: How far the camera is ahead of the axle that does not steer, in metres; negative behind it. How far
            it is to the side or above does not matter.
        forward: The vehicle's direction of travel in the camera's frame.
        up: The normal of the floor in the camera's frame.

    Returns:
        The factor that makes the translation metric, and how sensitive it is: the noise of θ and of the direction of t,
        in radians, times `sensitivity` is the relative error of `scale`. In gentle turns it is in the hundreds.

    Degenerate input: straight motion, a lever arm of zero, a turn that would need a negative scale, a sensitivity that
        lets rounding alone pass 10 % and anything not finite are not valid; the scale is then 0.
    Differentiability: both modes; zero where not valid.
    References: see the module, equation (3).

    Example:
        >>> axle, arm = arc_motion(jnp.asarray(0.2)), jnp.array([0.0, 0.0, 1.5])
        >>> moved = 2.0 * axle.translation() + axle.rotation() @ arm - arm
        >>> length = jnp.linalg.norm(moved)
        >>> pose = SE3(jnp.concatenate([axle.rotation().parameters(), moved / length]))
        >>> bool(jnp.isclose(scale_from_turn(pose, 1.5).scale, length, rtol=1e-3))
        True
    """
    parameters = cam1_from_cam0.parameters()
    dtype = parameters.dtype
    finite = jnp.all(jnp.isfinite(parameters)) & jnp.isfinite(jnp.asarray(lever_arm))
    pose = SE3(jnp.where(finite, parameters, jnp.eye(7, dtype=dtype)[0]))
    lever_arm = jnp.where(finite, jnp.asarray(lever_arm).astype(dtype), 0.0)
    up = _unit(up, dtype)
    ahead, left = _plane(_unit(forward, dtype), up)
    cosine, sine = _half_turn(pose, up)
    # The camera's displacement, in its new frame and then in the half-way frame.
    moved = -pose.translation()
    moved_ahead, moved_left = jnp.sum(moved * ahead), jnp.sum(moved * left)
    straight, aside = cosine * moved_ahead - sine * moved_left, sine * moved_ahead + cosine * moved_left
    eps = float(jnp.finfo(dtype).eps)
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(straight), jnp.abs(aside)))
    usable = (jnp.abs(aside) > NO_PARALLAX * eps * size) & (jnp.abs(sine) > NO_PARALLAX * eps) & (size > floor(size))
    slope = straight / jnp.where(usable, aside, 1.0)  # cot of the direction of t
    bend = 0.5 * cosine / jnp.where(usable, sine, 1.0)
    sensitivity = jnp.sqrt(jnp.where(usable, slope * slope + bend * bend, 1.0))
    scale = 2.0 * lever_arm * sine / jnp.where(usable, aside, 1.0)
    valid = usable & (scale > 0) & (sensitivity * NO_PARALLAX * eps < 0.1) & jnp.isfinite(scale)
    return ScaleFromTurn(jnp.where(valid, scale, 0.0), jnp.where(valid, sensitivity, 0.0), valid)
