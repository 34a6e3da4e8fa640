"""Ray-casting of upright boxes on a ground plane, with procedural texture: one jitted program for every frame.

A ray through a pixel is `origin + t * direction` with a direction whose camera z is 1, so `t` is the depth. Boxes are
tested in their own frames (slab test); the nearest hit is kept as one integer per ray, the depth's leading bits with
the number of box and face below them, so that the loop over boxes carries a single array.

Surfaces are shaded once per pixel, since their patterns are already filtered to the size of a pixel; only outlines are
supersampled. A sample that sees another surface than the pixel's centre takes the colour of the neighbouring pixel
whose centre sees that surface. That costs a quarter of shading every sample.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from vojax._types import Array, ArrayLike

from . import _texture as texture

# A surface code is box + 64 * face; faces are 0 (box z), 1 (box x) and 2 (lid).
_CODE_BITS = 8
GROUND, SKY = 62, 63
MAX_BOXES = 60
_UNROLL = 4
_NO_HIT = 2**31 - 1
_FAR = 1e6


class View(NamedTuple):
    """Everything about one picture that the compiled program takes as an argument.

    Attributes:
        rotation: Street-from-camera rotation matrix.
        intrinsics: fx, fy, cx, cy in pixels.
        boxes: Per box and relative to the camera: its origin in box x and z, cosine and sine of the yaw, half sizes
            in x and z, y of the top and of the bottom.
        materials: Per box, columns as `texture.Material`.
        ground: y of the ground relative to the camera; x and z of the camera in the street frame.
        lane: Lateral and longitudinal lane coordinates on a grid.
        lane_origin: Street x and z of the first grid point, and cells per metre.
        sun: Unit vector to the sun in the street frame.
        light: Gain on all radiance, and contrast of all texture.
    """

    rotation: ArrayLike
    intrinsics: ArrayLike
    boxes: ArrayLike
    materials: ArrayLike
    ground: ArrayLike
    lane: ArrayLike
    lane_origin: ArrayLike
    sun: ArrayLike
    light: ArrayLike


def _directions(view: View, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Rays through pixels, in the street frame, with a camera z of 1."""
    fx, fy, cx, cy = view.intrinsics
    x, y = (u - cx) / fx, (v - cy) / fy
    rotation = view.rotation
    dx, dy, dz = (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] for i in range(3))
    return dx, dy, dz


def _pixel_grid(width: int, height: int) -> tuple[Array, Array]:
    u = lax.broadcasted_iota(jnp.int32, (height, width), 1).astype(jnp.float32)
    v = lax.broadcasted_iota(jnp.int32, (height, width), 0).astype(jnp.float32)
    return u, v


def _nonzero(x: Array) -> Array:
    return jnp.where(jnp.abs(x) < 1e-9, 1e-9, x)


def _slabs(box, dx, dy_inverse, dz):
    """Entry depth along box x, y and z, and the smallest exit depth."""
    ox, oz, c, s, hx, hz, top, bottom = box
    rx = 1.0 / _nonzero(c * dx + s * dz)
    rz = 1.0 / _nonzero(c * dz - s * dx)
    ax, bx, az, bz = (-hx - ox) * rx, (hx - ox) * rx, (-hz - oz) * rz, (hz - oz) * rz
    ay, by = top * dy_inverse, bottom * dy_inverse
    enter = jnp.minimum(ax, bx), jnp.minimum(ay, by), jnp.minimum(az, bz)
    leave = jnp.minimum(jnp.minimum(jnp.maximum(ax, bx), jnp.maximum(az, bz)), jnp.maximum(ay, by))
    return enter, leave


def _nearest(view: View, directions: tuple[Array, Array, Array]) -> Array:
    """Code of the nearest surface: box and face, or `GROUND`, or `SKY`."""
    dx, dy, dz = directions
    mask = (1 << _CODE_BITS) - 1

    def pack(t: Array, code) -> Array:
        return (lax.bitcast_convert_type(t, jnp.int32) & ~mask) | code

    def some_boxes(step: Array, best: Array) -> Array:
        dy_inverse = 1.0 / _nonzero(dy)
        for offset in range(_UNROLL):
            number = step * _UNROLL + offset
            (ex, ey, ez), leave = _slabs(view.boxes[number], dx, dy_inverse, dz)
            side = jnp.maximum(ex, ez)
            enter = jnp.maximum(side, ey)
            code = number | jnp.where(ey > side, 128, jnp.where(ex > ez, 64, 0))
            hit = (enter < leave) & (enter > 0.05)
            best = jnp.minimum(best, jnp.where(hit, pack(enter, code), _NO_HIT))
        return best

    t_ground = view.ground[0] / _nonzero(dy)
    start = jnp.where((t_ground > 0) & (t_ground < 2000.0), pack(t_ground, GROUND), _NO_HIT)
    best = lax.fori_loop(0, MAX_BOXES // _UNROLL, some_boxes, start)
    return jnp.where(best == _NO_HIT, SKY, best & mask)


def _column(table: ArrayLike, j: int, row: Array) -> Array:
    return jnp.asarray(table)[:, j].at[row].get(mode="promise_in_bounds")


def _hit(view: View, directions: tuple[Array, Array, Array], code: Array) -> tuple[Array, tuple[Array, ...]]:
    """Exact depth on the plane of the coded face, and the box's parameters per ray."""
    dx, dy, dz = directions
    number = code & 63
    row = jnp.minimum(number, MAX_BOXES - 1)
    box = lax.optimization_barrier(tuple(_column(view.boxes, j, row) for j in range(8)))
    dy_inverse = 1.0 / _nonzero(dy)
    (ex, ey, ez), _ = _slabs(box, dx, dy_inverse, dz)
    t = jnp.where(code >= 128, ey, jnp.where(code >= 64, ex, ez))
    t = jnp.where(number == GROUND, view.ground[0] * dy_inverse, t)
    return jnp.where(number == SKY, _FAR, t), box


def _shadow(view: View, px: Array, py: Array, pz: Array, softness: Array) -> Array:
    """How much of the sun is hidden from camera-relative points.

    The chord of the sun's ray through a box falls to zero at the shadow's outline; a chord shorter than `softness`
    counts in proportion, which smooths the outline over about a pixel.
    """
    sx, sy, sz = view.sun
    sy_inverse = 1.0 / sy

    def some_boxes(step: Array, shadow: Array) -> Array:
        for offset in range(_UNROLL):
            ox, oz, c, s, hx, hz, top, bottom = view.boxes[step * _UNROLL + offset]
            rx, rz = 1.0 / _nonzero(c * sx + s * sz), 1.0 / _nonzero(c * sz - s * sx)
            qx, qz = (ox + c * px + s * pz) * rx, (oz + c * pz - s * px) * rz
            qy, y0, y1 = py * sy_inverse, top * sy_inverse, bottom * sy_inverse
            wx, wz = jnp.abs(hx * rx), jnp.abs(hz * rz)
            enter = jnp.maximum(jnp.maximum(-wx - qx, -wz - qz), jnp.minimum(y0, y1) - qy)
            leave = jnp.minimum(jnp.minimum(wx - qx, wz - qz), jnp.maximum(y0, y1) - qy)
            shadow = jnp.maximum(shadow, leave - jnp.maximum(enter, 0.02))
        return shadow

    chord = lax.fori_loop(0, MAX_BOXES // _UNROLL, some_boxes, jnp.zeros_like(px))
    return jnp.clip(chord / softness, 0.0, 1.0)


@functools.partial(jax.jit, static_argnames=("width", "height"))
def render_depth(view: View, *, width: int, height: int) -> Array:
    """Exact depth through the pixel centres; 0 for the sky."""
    directions = _directions(view, *_pixel_grid(width, height))
    code = _nearest(view, directions)
    t, _ = _hit(view, directions, code)
    return jnp.where(code == SKY, 0.0, t)


@functools.partial(jax.jit, static_argnames=("width", "height", "supersample"))
def render_image(view: View, key: Array, noise: Array, *, width: int, height: int, supersample: int) -> Array:
    """One picture, uint8, with sensor noise of standard deviation `noise` gray levels.

    A view with a leading axis on all its arrays is a moving camera: what it sees in turn is averaged.
    """
    if jnp.ndim(view.rotation) == 3:
        turn = functools.partial(_radiance, width=width, height=height, supersample=supersample)
        radiance = jnp.mean(lax.map(turn, view), axis=0)
        gain = view.light[0, 0]
    else:
        radiance, gain = _radiance(view, width=width, height=height, supersample=supersample), view.light[0]
    # A film-like curve lifts the shade.
    gray = 255.0 * jnp.power(jnp.clip(gain * radiance, 1e-4, 1.0), 1 / 1.4)
    gray = gray + noise * jax.random.normal(key, gray.shape, jnp.float32)
    return jnp.clip(jnp.round(gray), 0.0, 255.0).astype(jnp.uint8)


def _radiance(view: View, *, width: int, height: int, supersample: int) -> Array:
    u, v = _pixel_grid(width, height)
    directions = _directions(view, u, v)
    offsets = [(i + 0.5) / supersample - 0.5 for i in range(supersample)]
    samples = [(a, b) for b in offsets for a in offsets if supersample > 1]
    x, y, z = (jnp.stack([d, *(_shifted(d, a, b, view, i) for a, b in samples)]) for i, d in enumerate(directions))
    codes = lax.optimization_barrier(_nearest(view, (x, y, z)))
    radiance = lax.optimization_barrier(_shade(view, directions, codes[0]))
    return _blend_outlines(radiance, codes[0], codes[1:], samples) if samples else radiance


def _shifted(component: Array, a: float, b: float, view: View, row: int) -> Array:
    fx, fy, *_ = view.intrinsics
    return component + (view.rotation[row, 0] * a / fx + view.rotation[row, 1] * b / fy)


def _blend_outlines(radiance: Array, centre: Array, codes: Array, samples: list[tuple[float, float]]) -> Array:
    """Average the samples of each pixel, where each takes the colour of a nearby pixel centre on the same surface."""
    height, width = centre.shape
    padded_radiance, padded_code = jnp.pad(radiance, 1, mode="edge"), jnp.pad(centre, 1, mode="edge")

    def neighbour(padded: Array, right: int, down: int) -> Array:
        return padded[1 + down : 1 + down + height, 1 + right : 1 + right + width]

    total = jnp.zeros_like(radiance)
    for number, (a, b) in enumerate(samples):
        right, down = (a > 0) - (a < 0), (b > 0) - (b < 0)
        colour = radiance
        for i, j in ((right, down), (0, down), (right, 0), (0, 0)):
            same = codes[number] == neighbour(padded_code, i, j)
            colour = jnp.where(same, neighbour(padded_radiance, i, j), colour)
        total = total + colour
    return total / len(samples)


def _shade(view: View, directions: tuple[Array, Array, Array], code: Array) -> Array:
    """Radiance towards the camera, one value per ray."""
    dx, dy, dz = directions
    t, box = _hit(view, directions, code)
    ox, oz, c, s, hx, hz, top, bottom = box
    is_ground, is_sky, is_lid, is_x = code == GROUND, code == SKY, code >= 128, (code >= 64) & (code < 128)
    is_flat = is_lid | is_ground
    px, py, pz = t * dx, t * dy, t * dz

    # Surface coordinates in metres: along the face and up for walls, box x and z for lids, street x and z for ground.
    bx, bz = ox + c * px + s * pz, oz + c * pz - s * px
    lx, lz = c * dx + s * dz, c * dz - s * dx
    length = jnp.where(is_x, hz, hx)
    u, v = jnp.where(is_x, bz, bx) + length, bottom - py
    ground_x, ground_z = view.ground[1] + px, view.ground[2] + pz

    # Footprint of a pixel on the surface, metres: across the line of sight and along its slant.
    across = t / view.intrinsics[0]
    horizontal = jnp.sqrt(dx * dx + dz * dz)
    cosine = jnp.where(is_flat, jnp.abs(dy), jnp.abs(jnp.where(is_x, lx, lz)) / horizontal)
    slant = across / jnp.maximum(cosine, 0.02)

    # Outward normal's product with the sun.
    sx, sy, sz = view.sun
    sun_x, sun_z = c * sx + s * sz, c * sz - s * sx
    facing = jnp.where(is_x, -jnp.sign(lx) * sun_x, -jnp.sign(lz) * sun_z)
    facing = jnp.maximum(jnp.where(is_flat, -sy, facing), 0.0)

    row = jnp.minimum(code & 63, MAX_BOXES - 1)
    material = texture.Material(*(_column(view.materials, j, row) for j in range(len(texture.Material._fields))))
    away = jnp.where(jnp.where(is_x, lx, lz) > 0, 2, 0)
    seed = jnp.where(is_ground, 977, material.seed.astype(jnp.int32) * 8 + (code >> 6) + away).astype(jnp.uint32)
    texture_u = jnp.where(is_ground, ground_x, jnp.where(is_lid, bx, u))
    texture_v = jnp.where(is_ground, ground_z, jnp.where(is_lid, bz, v))
    (px, py, pz, u, v, length, texture_u, texture_v, seed, slant, across, horizontal, facing, material) = (
        lax.optimization_barrier(
            (px, py, pz, u, v, length, texture_u, texture_v, seed, slant, across, horizontal, facing, material)
        )
    )
    shadow = _shadow(view, px, py, pz, 0.05 + 3.0 * slant)
    grain = lax.optimization_barrier(texture.grain(texture_u, texture_v, seed, slant))
    wall = texture.wall(material, u, v, 2.0 * length, bottom - top, seed, grain, slant, across)
    wall = jnp.where(is_lid, 0.8 * material.albedo * (1.0 + 0.5 * grain), wall)
    lateral, along, heading = texture.lane_coordinates(
        jnp.asarray(view.lane), jnp.asarray(view.lane_origin), ground_x, ground_z
    )
    floor = texture.street(lateral, along, heading, dx / horizontal, dz / horizontal, across, slant)
    shadow, wall, floor = lax.optimization_barrier((shadow, wall, floor))

    albedo = jnp.where(is_ground, floor * (1.0 + grain), wall)
    albedo = 0.33 + view.light[1] * (albedo - 0.33)
    radiance = jnp.maximum(albedo, 0.01) * (0.40 + 1.15 * facing * (1.0 - shadow))
    haze = 1.0 - jnp.exp(-t / 350.0)
    return jnp.where(is_sky, texture.sky(dx, dy, dz, horizontal), radiance + haze * (0.8 - radiance))
