"""Procedural surfaces for the ray-caster: value noise, facades, the street and the sky.

Everything is elementwise over rays. Each pattern is faded or box-filtered by the size of a pixel on the surface, so
that nothing finer than a pixel remains to alias.
"""

from typing import NamedTuple

import jax.numpy as jnp

from vojax._types import Array

# Wavelengths in metres and amplitudes of the grain, coarse to fine.
_OCTAVES = ((5.3, 0.22), (2.3, 0.26), (1.1, 0.30), (0.53, 0.34), (0.26, 0.36), (0.12, 0.36), (0.06, 0.32))


class Material(NamedTuple):
    """What a box is made of.

    Attributes:
        albedo: Mean reflectance of the walls, 0 to 1.
        seed: Small whole number that makes the texture of this box its own.
        course_width: Width of a brick, slab or plank, metres.
        course_height: Height of one.
        cell_width: Wanted distance between window axes, metres.
        cell_height: Height of a storey.
        pane_width: Width of a window; 0 for none, -1 for wheels instead.
        pane_height: Height of one.
    """

    albedo: Array
    seed: Array
    course_width: Array
    course_height: Array
    cell_width: Array
    cell_height: Array
    pane_width: Array
    pane_height: Array


def hash_unit(ix: Array, iy: Array, seed: Array) -> Array:
    """Pseudo-random number in [0, 1) of a lattice point."""
    h = ix.astype(jnp.uint32) * jnp.uint32(0x8DA6B343) + iy.astype(jnp.uint32) * jnp.uint32(0xD8163841)
    return _mix(h + seed * jnp.uint32(0xCB1AB31F))


def _mix(h: Array) -> Array:
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> 12)) * jnp.uint32(0x297A2D39)
    h = h ^ (h >> 15)
    return (h >> 8).astype(jnp.int32).astype(jnp.float32) * (1.0 / 16777216.0)


def value_noise(x: Array, y: Array, seed: Array) -> Array:
    """Smooth noise of wavelength about 1 in [-0.5, 0.5], by interpolating hashed lattice values."""
    fx, fy = jnp.floor(x), jnp.floor(y)
    wx, wy = x - fx, y - fy
    wx, wy = wx * wx * (3.0 - 2.0 * wx), wy * wy * (3.0 - 2.0 * wy)
    kx, ky = jnp.uint32(0x8DA6B343), jnp.uint32(0xD8163841)
    h = fx.astype(jnp.int32).astype(jnp.uint32) * kx + fy.astype(jnp.int32).astype(jnp.uint32) * ky
    h = h + seed * jnp.uint32(0xCB1AB31F)
    a, b, c, d = _mix(h), _mix(h + kx), _mix(h + ky), _mix(h + kx + ky)
    top = a + wx * (b - a)
    return top + wy * (c + wx * (d - c) - top) - 0.5


def grain(u: Array, v: Array, seed: Array, footprint: Array) -> Array:
    """Relative variation of reflectance; each octave fades out before a pixel covers half its wavelength."""
    total = jnp.zeros_like(u)
    # Each octave is turned by about 37 degrees, so that the lattices do not line up.
    c, s = 0.7986, 0.6018
    for number, (wavelength, amplitude) in enumerate(_OCTAVES):
        u, v = c * u - s * v, s * u + c * v
        fade = jnp.clip((wavelength / jnp.maximum(footprint, 1e-6) - 1.3) / 2.0, 0.0, 1.0)
        octave = value_noise(u / wavelength + 13.7 * number, v / wavelength, seed + jnp.uint32(7919 * number))
        total = total + amplitude * fade * octave
    return total


def _pulse(x: Array, half_width, footprint: Array) -> Array:
    """Box-filtered indicator of |x| < half_width."""
    width = jnp.maximum(footprint, 1e-4)
    return jnp.clip((half_width - jnp.abs(x)) / width + 0.5, 0.0, 1.0) * jnp.minimum(1.0, 2.0 * half_width / width)


def _step(x: Array, footprint: Array) -> Array:
    """Box-filtered indicator of x > 0."""
    return jnp.clip(x / jnp.maximum(footprint, 1e-4) + 0.5, 0.0, 1.0)


def wall(
    material: Material,
    u: Array,
    v: Array,
    length: Array,
    height: Array,
    seed: Array,
    roughness: Array,
    du: Array,
    dv: Array,
) -> Array:
    """Reflectance of an upright face: courses of brick or planks, rows of windows, base and cornice.

    `u` runs along the face from its edge and `v` up from its foot, metres; `du` and `dv` are the pixel's footprint;
    `roughness` is the grain, which glass and paint show less of.
    """
    # Courses, in bond.
    row = jnp.floor(v / material.course_height)
    shifted = u / material.course_width + 0.5 * (row - 2.0 * jnp.floor(row / 2.0))
    column = jnp.floor(shifted)
    tone = hash_unit(column.astype(jnp.int32), row.astype(jnp.int32), seed) - 0.5
    from_joint = jnp.minimum(
        material.course_height * (0.5 - jnp.abs(v / material.course_height - row - 0.5)) + 0.0 * u,
        material.course_width * (0.5 - jnp.abs(shifted - column - 0.5)),
    )
    finest = jnp.maximum(du / material.course_width, dv / material.course_height)
    visible = jnp.clip(1.6 - 2.0 * finest, 0.0, 1.0)
    joint = 1.0 - _step(from_joint - 0.012, jnp.maximum(du, dv))
    car = jnp.where(material.pane_width < 0, 1.0, 0.0)
    value = material.albedo * (1.0 + visible * (0.30 * tone - 0.25 * joint)) * (1.0 + (1.0 - 0.75 * car) * roughness)

    # Windows: whole columns and rows centred on the face.
    columns = jnp.maximum(jnp.round((length - 0.5) / material.cell_width), 1.0)
    cell_width = (length - 0.5) / columns
    rows = jnp.maximum(jnp.floor((0.97 * height - 0.06) / material.cell_height), 0.0)
    uc, vc = (u - 0.25) / cell_width, v / material.cell_height
    ci, ri = jnp.floor(uc), jnp.floor(vc)
    inside = (ci >= 0) & (ci < columns) & (ri >= 0) & (ri < rows) & (material.pane_width > 0)
    x = (uc - ci - 0.5) * cell_width
    y = (vc - ri - 0.52) * material.cell_height
    half_x = 0.5 * jnp.minimum(material.pane_width, cell_width - 0.15)
    half_y = 0.5 * material.pane_height
    look = hash_unit(ci.astype(jnp.int32), ri.astype(jnp.int32), seed + jnp.uint32(31))
    other = hash_unit(ci.astype(jnp.int32), ri.astype(jnp.int32), seed + jnp.uint32(57))
    house = height > 4.0
    # On the ground floor one opening in three is a door: it reaches down to the pavement.
    door = house & (ri == 0) & (look < 0.33)
    foot = jnp.maximum(0.52 * material.cell_height - half_y, 0.0)
    half_y = jnp.where(door, half_y + 0.5 * foot, half_y)
    y = jnp.where(door, y + 0.5 * foot, y)
    frame = _pulse(x, half_x + 0.09, du) * _pulse(y, half_y + 0.09, dv)
    sill = _pulse(x, half_x + 0.18, du) * _pulse(y + half_y + 0.14, 0.06, dv)
    pane = _pulse(x, half_x, du) * _pulse(y, half_y, dv)
    bars = jnp.maximum(_pulse(x, 0.03, du), _pulse(y - 0.25 * half_y, 0.03, dv))
    # Glass reflects a little sky towards its top; some windows have a blind, drawn to a random height.
    glass = 0.05 + 0.16 * look * look + 0.07 * jnp.clip(y / jnp.maximum(half_y, 0.1), -1.0, 1.0) * other
    drawn = jnp.where(house & (look > 0.45), 2.2 * other, 0.0)
    blind = _step(y - half_y * (1.0 - drawn), dv) * jnp.where(drawn > 0, 1.0, 0.0)
    glass = glass + blind * (0.35 + 0.4 * look - glass)
    trim = jnp.where(material.albedo > 0.45, 0.28, 0.78)
    glass = glass + jnp.where(house, 0.9 * bars, 0.0) * (trim - glass)
    glass = jnp.where(door, 0.10 + 0.5 * other, glass) * (1.0 + 0.4 * roughness)
    gate = jnp.where(inside, 1.0, 0.0)
    value = value + gate * sill * (0.7 * trim - value)
    value = value + gate * frame * (trim - value)
    value = value + gate * pane * (glass - value)

    # String courses between storeys, a darker base and a cornice for anything as tall as a house.
    house = jnp.where(house, 1.0, 0.0)
    band = _pulse(v - jnp.round(vc) * material.cell_height, 0.07, dv)
    value = value * (1.0 + 0.28 * house * band)
    value = value * (1.0 - 0.35 * house * (1.0 - _step(v - 0.55, dv)))
    value = value * (1.0 - 0.45 * house * _pulse(height - v - 0.42, 0.06, dv))
    value = value * (1.0 + 0.25 * house * _step(v - height + 0.36, dv))
    value = value * (0.72 + 0.28 * jnp.clip(v / 1.2, 0.0, 1.0))

    # A car: wheels with bright rims, and a light strip along its side.
    from_axle = jnp.abs(jnp.abs(u - 0.5 * length) - 0.31 * length)
    radius = jnp.sqrt(from_axle * from_axle + (v - 0.12) * (v - 0.12))
    footprint = jnp.maximum(du, dv)
    value = value + car * _pulse(v - 0.42, 0.025, dv) * (0.5 - value)
    wheels = car * jnp.where(length > 2.5, 1.0, 0.0)
    value = value + wheels * _step(0.33 - radius, footprint) * (0.04 - value)
    value = value + wheels * _step(0.17 - radius, footprint) * (0.55 - value)
    # Lamps and a number plate at both ends.
    ends = car - wheels
    lamp = _pulse(jnp.abs(u - 0.5 * length) - 0.36 * length, 0.14, du) * _pulse(v - 0.40, 0.07, dv)
    plate = _pulse(u - 0.5 * length, 0.26, du) * _pulse(v - 0.20, 0.06, dv)
    return value + ends * jnp.maximum(lamp, plate) * (0.8 - value)


def lane_coordinates(lane: Array, origin: Array, x: Array, z: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Interpolate the lateral and longitudinal lane coordinate, and the lateral direction, from a grid."""
    rows, columns = lane.shape[1], lane.shape[2]
    gx = jnp.clip((x - origin[0]) * origin[2], 0.0, columns - 1.001)
    gz = jnp.clip((z - origin[1]) * origin[2], 0.0, rows - 1.001)
    ix, iz = jnp.floor(gx), jnp.floor(gz)
    wx, wz = gx - ix, gz - iz
    index = iz.astype(jnp.int32) * columns + ix.astype(jnp.int32)

    def corners(channel: int) -> tuple[Array, Array, Array, Array]:
        table = lane[channel].reshape(-1)
        return tuple(  # type: ignore[return-value]
            table.at[index + step].get(mode="promise_in_bounds") for step in (0, 1, columns, columns + 1)
        )

    a, b, c, d = corners(0)
    lateral = (1 - wz) * ((1 - wx) * a + wx * b) + wz * ((1 - wx) * c + wx * d)
    gradient_x = ((1 - wz) * (b - a) + wz * (d - c)) * origin[2]
    gradient_z = ((1 - wx) * (c - a) + wx * (d - b)) * origin[2]
    a, b, c, d = corners(1)
    along = (1 - wz) * ((1 - wx) * a + wx * b) + wz * ((1 - wx) * c + wx * d)
    return lateral, along, (gradient_x, gradient_z)


def street(
    lateral: Array, along: Array, heading: tuple[Array, Array], dx: Array, dz: Array, across: Array, slant: Array
) -> Array:
    """Reflectance of the ground: asphalt with patches and markings, kerbs, paving and grass."""
    # Footprint in lane coordinates: the long axis lies along the horizontal line of sight.
    turned = jnp.clip(jnp.abs(heading[0] * dx + heading[1] * dz), 0.0, 1.0)
    d_lateral = across + turned * slant
    d_along = across + (1.0 - turned) * slant
    centre = lateral + 1.75
    from_centre = jnp.abs(centre)
    # Repairs of random size in cells of the road.
    cu, cv = along / 2.7, lateral / 1.7
    iu, iv = jnp.floor(cu), jnp.floor(cv)
    one = jnp.ones_like(iu, dtype=jnp.uint32)
    size = hash_unit(iu.astype(jnp.int32), iv.astype(jnp.int32), one * 5)
    tone = hash_unit(iu.astype(jnp.int32), iv.astype(jnp.int32), one * 9)
    patch = _pulse((cu - iu - 0.5) * 2.7, 0.3 + 0.9 * size, d_along) * _pulse(
        (cv - iv - 0.5) * 1.7, 0.2 + 0.5 * tone, d_lateral
    )
    road = 0.27 + patch * jnp.where(size > 0.35, 0.24 * (tone - 0.55), 0.0)
    dash = along / 6.0 - jnp.floor(along / 6.0) - 0.5
    line = _pulse(centre, 0.07, d_lateral) * _pulse(dash * 6.0, 1.5, d_along)
    edge = _pulse(from_centre - 3.55, 0.06, d_lateral)
    road = road + 0.85 * jnp.maximum(line, edge) * (0.85 - road)

    # Paving slabs of 0.6 m.
    su, sv = along / 0.6, lateral / 0.6
    ju, jv = jnp.floor(su), jnp.floor(sv)
    slab = hash_unit(ju.astype(jnp.int32), jv.astype(jnp.int32), one * 3) - 0.5
    clear = jnp.clip(1.6 - 2.0 * jnp.maximum(d_along, d_lateral) / 0.6, 0.0, 1.0)
    joint = jnp.maximum(
        _pulse((su - ju - 0.5) * 0.6 - 0.28, 0.02, d_along), _pulse((sv - jv - 0.5) * 0.6 - 0.28, 0.02, d_lateral)
    )
    paving = 0.46 * (1.0 + clear * (0.28 * slab - 0.4 * joint))

    value = road + _step(from_centre - 5.85, d_lateral) * (paving - road)
    value = value + _pulse(from_centre - 5.85, 0.13, d_lateral) * (0.66 - value)
    return value + _step(from_centre - 10.5, d_lateral) * (0.30 - value)


def sky(dx: Array, dy: Array, dz: Array, horizontal: Array) -> Array:
    """Radiance of a sky that darkens upwards, with soft clouds."""
    elevation = -dy / horizontal
    x, z = dx / (0.25 + jnp.abs(dy)), dz / (0.25 + jnp.abs(dy))
    seed = jnp.full(x.shape, 4242, jnp.uint32)
    cloud = value_noise(1.1 * x, 1.1 * z, seed) + 0.5 * value_noise(2.7 * x, 2.7 * z, seed + jnp.uint32(1))
    return 0.92 - 0.35 * jnp.clip(elevation, 0.0, 1.0) + 0.10 * cloud
