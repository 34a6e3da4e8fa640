"""Relative pose from two points and motion in a plane: two epipolar equations, two poses.

A vehicle on a floor turns about the vertical and moves across it:

    t . (R f_i x g_i) = 0,     R u0 = u1,     t . u1 = 0,     |t| = 1,     i = 0, 1.                               (1)

In the notation of the upright three-point solver, the horizontal part of R f x g, seen from the frame halfway between
the cameras, is Z = p (g_y f - f_y g) - iq (g_y f + f_y g), linear in p = cos θ/2 and q = sin θ/2. Both Z are at right
angles to t, so they are parallel: a quadratic in tan(θ/2), in which a half turn (p = 0) is an ordinary root. As there,
f is first turned to align with g and q is measured in units of the parallax σ: of far points, the roots differ by σ.

Precondition: two points in different directions, both off the plane of motion through the cameras, and a motion that is
not a pure rotation.

References:
    S. Choi, J.-H. Kim. Fast and reliable minimal relative pose estimation under planar motion. Image and Vision
        Computing 69, 2018.
"""

import jax.numpy as jnp

from vojax._types import Array, ArrayLike, Float
from vojax.lie import SE3

from ._candidates import Candidates
from ._implicit import implicit, perturb_camera
from ._lanes import lanes_last
from ._roots import quadratic_roots
from ._upright_three_point import (
    NO_PARALLAX,
    UP,
    Data,
    align_horizontally,
    angle_error,
    arrays,
    choose_sign,
    placeholders,
    pose_components,
    turn,
    upright_bearings,
    upright_frame,
    upright_motion,
)


def _kernel(rays0: Array, rays1: Array, up0: Array, up1: Array) -> tuple[Array, Array]:
    """Poses [2, 7, *lanes] and validity [2, *lanes]."""
    eps = float(jnp.finfo(rays0.dtype).eps)
    axes0, proper0 = upright_frame(up0)
    axes1, proper1 = upright_frame(up1)
    f, finite0 = upright_bearings(rays0, axes0)
    g, finite1 = upright_bearings(rays1, axes1)
    proper = proper0 & proper1 & finite0 & finite1
    f, (cosine, sine) = align_horizontally(f, g)

    # g_y f - f_y g = a + i c and g_y f + f_y g = d + i b, so that Z = p a + q b + i (p c - q d).
    gap = tuple(f[i] - g[i] for i in range(3))
    a, c = g[1] * gap[0] - gap[1] * g[0], g[1] * gap[2] - gap[1] * g[2]
    d, b = g[1] * f[0] + f[1] * g[0], g[1] * f[2] + f[1] * g[2]
    sigma = jnp.max(jnp.maximum(jnp.abs(a), jnp.abs(c)), axis=0)
    proper = proper & (sigma > NO_PARALLAX * eps)
    sigma = jnp.where(proper, sigma, 1.0)
    a, c = a / sigma[None], c / sigma[None]

    # Im(conj(Z0) Z1) in q / (σ p); every factor of a term is off by eps / σ.
    quadratic = jnp.stack(
        [
            a[0] * c[1] - a[1] * c[0],
            (b[0] * c[1] - a[0] * d[1]) - (b[1] * c[0] - a[1] * d[0]),
            b[1] * d[0] - b[0] * d[1],
        ]
    )
    scale = jnp.sum(jnp.abs(a) + jnp.abs(b) + jnp.abs(c) + jnp.abs(d), axis=0)
    proper = proper & (jnp.max(jnp.abs(quadratic), axis=0) > 2.0 * eps * scale / sigma)
    (u, v), valid = quadratic_roots(quadratic)
    # A double root counts once.
    met = jnp.abs(u[0] * v[1] - u[1] * v[0]) < 0.5 * eps**0.5
    valid = jnp.stack([valid[0], valid[1] & ~met])

    s = sigma[None]
    length = jnp.sqrt(v * v + s * s * u * u)
    p, y = v / length, u / length
    q = s * y
    slope = p * p - q * q
    slope = slope * quadratic[1][None] + 2.0 * p * y * (quadratic[2] - quadratic[0] * sigma * sigma)[None]
    blur = angle_error((2.0 * eps * scale)[None], slope)
    across = p[None] * a[:, None] + y[None] * b[:, None]
    along = p[None] * c[:, None] - y[None] * d[:, None]
    # t is at right angles to both; the longer one is the more certain.
    squares = across * across + along * along
    first = squares[0] > squares[1]
    length = jnp.sqrt(jnp.maximum(jnp.maximum(squares[0], squares[1]), eps * eps))
    t = (
        jnp.where(first, across[0], across[1]) / length,
        jnp.zeros_like(length),
        jnp.where(first, along[0], along[1]) / length,
    )
    valid = valid & proper[None] & (s * length > NO_PARALLAX * eps)
    ahead = turn(p[None], q[None], tuple(x[:, None] for x in f))
    behind = turn(p[None], -q[None], tuple(x[:, None] for x in g))
    # Of n_y, Im(f ḡ) after all turns; its square completes |n|².
    level = ahead[2] * behind[0] - ahead[0] * behind[2]
    sense, in_front = choose_sign(ahead, behind, (-s[None] * along, level, s[None] * across), t, blur)
    valid = valid & in_front
    t = turn(p, q, tuple(sense * x for x in t))
    c2, s2 = p * p - q * q, 2.0 * p * q
    angle = (c2 * cosine[None] - s2 * sine[None], c2 * sine[None] + s2 * cosine[None])
    return placeholders(pose_components(axes0, axes1, angle, t), valid)


_solve = lanes_last(_kernel)


def _equations(cam1_from_cam0: SE3, data: Data) -> Array:
    epipolar, across, length, up1 = upright_motion(cam1_from_cam0, data)
    climb = jnp.sum(cam1_from_cam0.translation() * up1)
    return jnp.concatenate([epipolar, across, length, climb[None]])


def _candidates(data: Data) -> Candidates[SE3]:
    models, valid = _solve(*data)
    return Candidates(models=SE3(models), valid=valid)


_planar_two_point = implicit(_candidates, _equations, perturb_camera, 6)


def planar_two_point(
    rays0: Float[ArrayLike, "2 3"],
    rays1: Float[ArrayLike, "2 3"],
    up0: Float[ArrayLike, "3"] = UP,
    up1: Float[ArrayLike, "3"] = UP,
) -> Candidates[SE3]:
    """Find the relative poses of a camera that moves in a horizontal plane from two correspondences.

    For vehicles and robots on a floor, however the camera is mounted: give the floor's normal as `up0` and `up1`. With
    a camera ahead of a fixed axle, `scale_from_turn` then finds the length of the translation.

    Args:
        rays0: Directions to the points in camera 0's frame, one per row, of any positive length.
        rays1: Directions to the same points in camera 1's frame.
        up0: The normal of the plane of motion in camera 0's frame, of any length; by default the camera's -y axis.
        up1: The same direction in camera 1's frame.

    Returns:
        Two slots of `cam1_from_cam0` with |t| = 1. Valid slots take `up0` to `up1`, move across them, satisfy the
        epipolar equations and have both points in front (which of ±t does so is chosen; where neither does, the slot is
        not valid). The others hold the identity.

    Degenerate input: no slot is valid if a rotation about the normal explains the rays to rounding (no parallax), if
        the correspondences are the same, if a point is at the height of both cameras, for zero rays or normals and
        anything not finite. One of the points may be at infinity.
    Differentiability: both modes, any order, in all arguments, by the implicit function theorem; zero for slots that
        are not valid and at double roots.

    Raises:
        ValueError: If an array has another shape.
    References: see the module.

    Example:
        >>> rays0 = jnp.array([[0.0, 0.5, 1.0], [0.3, -0.2, 1.0]])
        >>> depths = jnp.array([[4.0], [5.0]])
        >>> candidates = planar_two_point(rays0, rays0 * depths - jnp.array([[0.0, 0.0, 1.0]]))
        >>> errors = jnp.abs(candidates.models.translation() - jnp.array([[0.0, 0.0, -1.0]])).max(axis=-1)
        >>> bool(jnp.any(candidates.valid & (errors < 1e-3)))
        True
    """
    return _planar_two_point(arrays((2, 3), (rays0, rays1), (up0, up1)))
