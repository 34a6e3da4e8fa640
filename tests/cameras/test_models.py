"""Every camera model against OpenCV, COLMAP, polynomial roots, each other, its own inverse and central differences."""

import functools
import json
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest

from vojax.cameras import (
    BrownConrady,
    Camera,
    DoubleSphere,
    ExtendedUnified,
    KannalaBrandt,
    Pinhole,
    Scaramuzza,
    Spherical,
    Unified,
)

# Parameters, and the half angle in degrees that an image of the model may reach.
MODELS = {
    "pinhole": (Pinhole, (458.7, 457.3, 367.2, 248.4, 2.0), 75.0),
    "brown_conrady": (BrownConrady, (458.654, 457.296, 367.215, 248.375, -0.283, 0.074, 2e-4, 2e-5, 0.0), 60.0),
    "kannala_brandt": (KannalaBrandt, (190.98, 190.97, 254.9, 256.9, 3.5e-3, 7e-4, -2.05e-3, 2.03e-4), 178.0),
    "kannala_brandt_folding": (KannalaBrandt, (300.0, 301.0, 512.0, 511.0, -0.05, 0.01, -0.003, 2e-4), 120.0),
    "unified_mirror": (Unified, (600.0, 610.0, 512.0, 500.0, 0.9), 140.0),
    "unified_beyond_one": (Unified, (600.0, 610.0, 512.0, 500.0, 1.5), 125.0),
    "unified_lens": (Unified, (600.0, 610.0, 512.0, 500.0, 1.1, -0.1, 0.03, 1e-3, -1e-3), 110.0),
    "extended_unified": (ExtendedUnified, (461.0, 459.6, 365.9, 249.3, 0.592, 1.124), 125.0),
    "extended_unified_flat": (ExtendedUnified, (461.0, 459.6, 365.9, 249.3, 0.4, 1.1), 120.0),
    "double_sphere": (DoubleSphere, (351.0, 350.0, 365.9, 249.3, -0.2385, 0.5679), 115.0),
    "double_sphere_positive": (DoubleSphere, (351.0, 350.0, 365.9, 249.3, 0.2, 0.4), 115.0),
    "scaramuzza": (Scaramuzza, (520.0, 390.0, 260.0, -9e-4, 4e-7, -1.4e-9, 1.0004, 2e-4, -3e-4), 140.0),
    "scaramuzza_mirror": (Scaramuzza, (520.0, 390.0, 150.0, -1 / 300.0), 140.0),
    "scaramuzza_sixth": (
        lambda *args: Scaramuzza(*args, higher=(1e-12, -1e-16)),
        (520.0, 390.0, 260.0, -1.2e-3, 8e-7, -3e-9, 1.0004, 2e-4, -3e-4),
        130.0,
    ),
    "spherical": (Spherical, (325.9, 325.9, 1023.5, 511.5), 175.0),
}
BACKWARD = [name for name, (*_, angle) in MODELS.items() if angle > 90]

COUNT = 300


class There(NamedTuple):
    """What a camera makes of points, and of pixels."""

    pixels: Any
    inside: Any
    bearings: Any
    normalized: Any


@jax.jit
def both_ways(camera, points, pixels):
    """Compiled once per model and precision: run eagerly, the tests would compile each operation on its own."""
    return There(camera.project(points), camera.in_domain(points), camera.unproject(pixels), camera.normalized(pixels))


def padded(rows, width):
    """Rows, repeated to the one shape that is compiled."""
    return np.resize(np.asarray(rows), (COUNT, width))


def project(camera, points):
    dtype = camera.cx.dtype
    rows = jnp.asarray(padded(points, 3), dtype)
    return np.asarray(both_ways(camera, rows, jnp.zeros((COUNT, 2), dtype)).pixels)[: len(points)]


def in_domain(camera, points):
    dtype = camera.cx.dtype
    rows = jnp.asarray(padded(points, 3), dtype)
    return np.asarray(both_ways(camera, rows, jnp.zeros((COUNT, 2), dtype)).inside)[: len(points)]


def unproject(camera, pixels):
    dtype = camera.cx.dtype
    rows = jnp.asarray(padded(pixels, 2), dtype)
    return np.asarray(both_ways(camera, jnp.ones((COUNT, 3), dtype), rows).bearings)[: len(pixels)]


def normalized(camera, pixels):
    dtype = camera.cx.dtype
    rows = jnp.asarray(padded(pixels, 2), dtype)
    return np.asarray(both_ways(camera, jnp.ones((COUNT, 3), dtype), rows).normalized)[: len(pixels)]


def model(name, dtype=jnp.float64):
    build, parameters, _ = MODELS[name]
    return jax.tree.map(lambda leaf: leaf.astype(dtype), build(*parameters))


def bearings_within(angle_deg, count=300):
    """Unit vectors in a spiral from the axis (the first is on it) to an angle from it."""
    theta, phi = np.radians(np.linspace(0, angle_deg, count)), np.linspace(0, 70, count)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


@pytest.mark.parametrize("name", MODELS)
def test_projection_and_its_inverse_agree_over_the_whole_field_of_view(name, x64):
    camera, angle = model(name), MODELS[name][2]
    bearings = bearings_within(angle)
    points = bearings * np.linspace(0.1, 50, len(bearings))[:, None]
    pixels = project(camera, points)
    assert isinstance(camera, Camera)
    assert in_domain(camera, points).all()
    found = unproject(camera, pixels)
    np.testing.assert_allclose(found, bearings, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-14)
    front = np.flatnonzero(bearings[:, 2] > 0.02)
    expected = bearings[front, :2] / bearings[front, 2:]
    np.testing.assert_allclose(normalized(camera, pixels)[front], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_float32_round_trip_stays_within_a_thousandth_of_a_pixel(name):
    with jax.enable_x64(True):
        pixels = np.asarray(project(model(name), bearings_within(MODELS[name][2])))
    pixels = pixels[np.abs(pixels).max(axis=1) < 2048].astype(np.float32)
    camera = model(name, jnp.float32)
    again = project(camera, unproject(camera, pixels))
    assert again.dtype == np.float32
    assert np.abs(again - pixels).max() < 1e-3


@pytest.mark.parametrize("name", BACKWARD)
def test_normalized_of_rays_to_the_side_and_backwards_is_on_the_last_circle(name, x64):
    camera = model(name)
    bearings = bearings_within(MODELS[name][2])
    beyond = bearings[:, 2] < 0.005
    plane = np.asarray(normalized(camera, project(camera, bearings)))[beyond]
    expected = 100 * bearings[beyond, :2] / np.linalg.norm(bearings[beyond, :2], axis=1, keepdims=True)
    assert beyond.any()
    np.testing.assert_allclose(plane, expected, atol=1e-8)


def fisheye_oracle(points, parameters):
    matrix = np.array([[parameters[0], 0, parameters[2]], [0, parameters[1], parameters[3]], [0, 0, 1.0]])
    return cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(parameters[4:8]))[0]


@pytest.mark.parametrize("name", ["kannala_brandt", "kannala_brandt_folding"])
def test_kannala_brandt_agrees_with_opencv(name, x64):
    camera, parameters = model(name), MODELS[name][1]
    points = bearings_within(85) * 3.0
    expected = fisheye_oracle(points, parameters)[:, 0]
    np.testing.assert_allclose(project(camera, points), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "colmap", "parameters"),
    [
        ("kannala_brandt", "OPENCV_FISHEYE", MODELS["kannala_brandt"][1]),
        ("extended_unified", "EUCM", MODELS["extended_unified"][1]),
        ("extended_unified_flat", "EUCM", MODELS["extended_unified_flat"][1]),
        # ξ = α / (1 − α), and the focal length that of the axis.
        ("unified_mirror", "EUCM", (600.0 / 1.9, 610.0 / 1.9, 512.0, 500.0, 0.9 / 1.9, 1.0)),
        ("unified_beyond_one", "EUCM", (600.0 / 2.5, 610.0 / 2.5, 512.0, 500.0, 1.5 / 2.5, 1.0)),
        ("spherical", "EQUIRECTANGULAR", (2048.0, 1024.0)),
        ("brown_conrady", "OPENCV", MODELS["brown_conrady"][1][:8]),
    ],
)
def test_models_agree_with_colmap(name, colmap, parameters, x64):
    build, own, angle = MODELS[name]
    camera = Spherical.from_size(2048, 1024) if name == "spherical" else build(*own)
    oracle = pycolmap.Camera(model=colmap, width=2048, height=1024, params=list(parameters))
    # COLMAP's fisheye ends at 90 degrees.
    points = bearings_within(85 if colmap == "OPENCV_FISHEYE" else angle) * 2.0
    shift = 0.5 if name == "spherical" else 0.0  # the principal point of the others is given, that of a panorama is not
    expected = oracle.img_from_cam(points, check_cheirality=False) - shift
    np.testing.assert_allclose(project(camera, points), expected, atol=1e-9)
    rays = oracle.cam_ray_from_img(np.asarray(expected + shift))
    inside = np.isfinite(rays).all(axis=1)
    assert inside[points[:, 2] > 0].all()
    np.testing.assert_allclose(np.asarray(unproject(camera, expected))[inside], rays[inside], atol=1e-8)


def test_unified_with_a_lens_is_opencvs_pinhole_behind_the_sphere(x64):
    camera, (fx, fy, cx, cy, xi, *lens) = model("unified_lens"), MODELS["unified_lens"][1]
    bearings = bearings_within(110)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    shifted = bearings + np.array([0, 0, xi])
    expected, _ = cv2.projectPoints(shifted, np.zeros(3), np.zeros(3), matrix, np.array(lens))
    np.testing.assert_allclose(project(camera, 7.0 * bearings), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", ["double_sphere", "double_sphere_positive"])
def test_double_sphere_is_a_unified_camera_behind_a_shifted_sphere(name, x64):
    camera, (fx, fy, cx, cy, xi, alpha) = model(name), MODELS[name][1]
    bearings = bearings_within(115)
    second = bearings + np.array([0, 0, xi])
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    pinhole = second + np.array([0, 0, alpha / (1 - alpha)])
    expected = pinhole[:, :2] / pinhole[:, 2:] * [fx / (1 - alpha), fy / (1 - alpha)] + [cx, cy]
    np.testing.assert_allclose(project(camera, bearings), expected, atol=1e-9)


@pytest.mark.parametrize("name", ["scaramuzza", "scaramuzza_mirror", "scaramuzza_sixth"])
def test_scaramuzza_finds_the_smallest_root_of_its_polynomial(name, x64):
    camera, angle = model(name), MODELS[name][2]
    stretch = np.array([[camera.c, camera.d], [camera.e, 1.0]])
    polynomial = [float(a) for a in (camera.a0, 0.0, camera.a2, camera.a3, camera.a4, *camera.higher)]
    bearings = bearings_within(angle)[1::30]
    for bearing, pixel in zip(bearings, project(camera, bearings), strict=True):
        sine = np.hypot(bearing[0], bearing[1])
        equation = np.array(polynomial) * sine
        equation[1] -= bearing[2]
        roots = np.roots(equation[::-1])
        radius = min(root.real for root in roots if abs(root.imag) < 1e-6 and root.real > 0)
        expected = stretch @ (bearing[:2] / sine * radius) + [camera.cx, camera.cy]
        np.testing.assert_allclose(pixel, expected, atol=1e-7)


DOMAIN_ENDS = {
    "unified_mirror": np.degrees(np.arccos(-0.9)),
    "unified_beyond_one": np.degrees(np.arccos(-1 / 1.5)),
    "kannala_brandt": 180.0,
    "spherical": 180.0,
    "pinhole": 90.0,
    # The ray (ρ, 1 − ρ² / 2) at the largest radius.
    "scaramuzza_mirror": np.degrees(np.arctan2(100.0, 1 - 0.5 * 100.0**2)),
}


@pytest.mark.parametrize("name", MODELS)
def test_rays_outside_the_domain_are_those_that_share_their_pixels(name, x64):
    camera = model(name)
    bearings = bearings_within(179.9)
    inside = np.asarray(in_domain(camera, bearings))
    angles = np.degrees(np.arccos(bearings[:, 2]))
    end = angles[inside].max()
    assert inside[angles <= end].all()
    if name in DOMAIN_ENDS:
        assert abs(end - DOMAIN_ENDS[name]) < 180 / 299 + 0.2
    if not inside.all() and name != "brown_conrady":
        # Past the rim nothing comes back as itself.
        error = np.abs(np.asarray(unproject(camera, project(camera, bearings))) - bearings).max(axis=1)
        assert (error[angles > end + 2] > 1e-3).all()
    assert not in_domain(camera, np.zeros((1, 3)))[0]


def test_folding_fisheye_ends_where_its_polynomial_does(x64):
    k = np.array(MODELS["kannala_brandt_folding"][1][4:])
    roots = np.roots([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1])
    end = np.sqrt(min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0))
    camera = model("kannala_brandt_folding")
    before, after = bearings_within(np.degrees(end) - 0.01), bearings_within(np.degrees(end) + 0.01)
    assert in_domain(camera, before)[-1]
    assert not in_domain(camera, after)[-1]


def test_lens_ends_where_its_radial_polynomial_does(x64):
    camera = BrownConrady(100.0, 100.0, 0.0, 0.0, k1=-0.25)  # x (1 − x²/4) grows up to √(4/3)
    points = np.stack([np.linspace(0.5, 2.0, 300), np.zeros(300), np.ones(300)], axis=1)
    np.testing.assert_array_equal(in_domain(camera, points), points[:, 0] < (4 / 3) ** 0.5)
    assert not in_domain(camera, -points).any()


WEIGHTS = np.array([1.0, -0.7, 0.4, 0.9, -0.3])


@functools.partial(jax.jit, static_argnums=0)
def derivatives(structure, inputs):
    """Derivatives by [point, pixel, parameters] of [the point's pixel, the pixel's bearing], forward and numeric.

    Also, by reverse mode, those of a weighted sum.
    """

    def both(one):
        camera = jax.tree.unflatten(structure, list(one[5:]))
        return jnp.concatenate([camera.project(one[:3]) / 300.0, camera.unproject(one[3:5])])

    forward = jax.vmap(jax.jacfwd(both))(inputs)
    reverse = jax.vmap(jax.grad(lambda one: jnp.dot(WEIGHTS, both(one))))(inputs)
    # Steps that move the outcome by a millionth, whatever the unit of the input.
    steps = 1e-6 / jnp.maximum(jnp.abs(forward).max(axis=(0, 1)), 1e-3)
    shifts = jnp.diag(steps)
    moved = jax.vmap(jax.vmap(both))(jnp.concatenate([inputs[None] + shifts[:, None], inputs[None] - shifts[:, None]]))
    plus, minus = jnp.split(moved, 2)
    return forward, reverse, jnp.moveaxis((plus - minus) / (2 * steps)[:, None, None], 0, -1)


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_match_central_differences(name, x64):
    camera = model(name)
    leaves, structure = jax.tree.flatten(camera)
    bearings = bearings_within(0.9 * MODELS[name][2])
    some = np.array([0, 40, 160, 299])
    inputs = np.concatenate(
        [1.5 * bearings[some], project(camera, bearings)[some], np.broadcast_to(np.stack(leaves), (4, len(leaves)))],
        axis=1,
    )
    forward, reverse, numeric = (np.asarray(values) for values in derivatives(structure, inputs))
    size = np.maximum(np.abs(forward).max(axis=(0, 1)), 1e-3)
    np.testing.assert_allclose(WEIGHTS @ (forward / size), reverse / size, atol=1e-10)
    np.testing.assert_allclose(forward / size, numeric / size, atol=1e-6)


@jax.jit
def first_and_second(camera, points, step):
    first = jax.vmap(jax.jacfwd(camera.project))
    shifts = step * jnp.eye(3)
    numeric = [(first(points + shift[None]) - first(points - shift[None])) / (2 * step) for shift in shifts]
    return jax.vmap(jax.jacfwd(jax.jacfwd(camera.project)))(points), jnp.stack(numeric, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kannala_brandt", "scaramuzza", "unified_lens"])
def test_second_derivatives_match_differences_of_the_first(name, x64):
    points = bearings_within(0.9 * MODELS[name][2])[[0, 35, 160]] * 1.5
    second, numeric = first_and_second(model(name), points, 1e-5)
    np.testing.assert_allclose(second, numeric, rtol=1e-4, atol=1e-2)


@jax.jit
def all_gradients(camera, points, pixels):
    """Derivatives of both ways, and of all outcomes together by everything."""

    def total(camera, points, pixels):
        return jnp.sum(camera.project(points)) + jnp.sum(camera.unproject(pixels))

    together = jax.grad(total, argnums=(0, 1, 2))(camera, points, pixels)
    return jax.vmap(jax.jacfwd(camera.project))(points), jax.vmap(jax.jacfwd(camera.unproject))(pixels), together


@pytest.mark.parametrize("name", [name for name in MODELS if name != "scaramuzza_sixth"])
def test_degenerate_points_and_pixels_stay_finite_in_value_and_gradient(name):
    camera = model(name, jnp.float32)
    some = [
        [0, 0, 0], [1, -2, 0], [1, 1, -2], [0, 0, -1], [1, 0, 1e-12], [30, 30, 1e-6], [1e4, 1e4, 1e-3], [3, 4, 1e-45],
        [0, 0, 1], [1e-20, 0, 1], [1e-20, 0, -1], [1e-5, 1e-5, -1], [0, 1, 0], [0, 1, 1e-9],
    ]  # fmt: skip
    angles = np.linspace(0.9 * np.radians(MODELS[name][2]), np.pi, 286)
    points = np.concatenate([some, np.stack([np.sin(angles), np.zeros(286), np.cos(angles)], axis=1)])
    centre = project(camera, np.array([[0.0, 0.0, 1.0]]))
    pixels = np.concatenate(
        [
            centre + np.linspace(0, 2000, 290)[:, None],
            [[-4e3, 1e2], [5e3, 5e3], [1e6, -1e6], [3e2, 1e8], [0, 0]],
            centre + np.array([[0, 0], [1e-4, 0], [0, 1e5], [1e-30, 0], [-1e7, 1]]),
        ]
    )
    points, pixels = jnp.asarray(points, jnp.float32), jnp.asarray(pixels, jnp.float32)
    there = both_ways(camera, points, pixels)
    by_point, by_pixel, together = all_gradients(camera, points, pixels)
    assert np.isfinite(there.pixels).all()
    # Solvers square them before a mask can drop them.
    assert np.isfinite(np.sum(np.asarray(by_point) ** 2, axis=(1, 2))).all()
    assert np.isfinite(by_pixel).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(together))
    assert np.isfinite(there.normalized).all()
    np.testing.assert_allclose(np.linalg.norm(there.bearings, axis=1), 1.0, atol=2e-3)


@jax.jit
def elementwise(camera, x, y, z):
    u, v = camera.project_xyz(x, y, z)
    return u, v, *camera.unproject_uv(u, v), camera.in_domain_xyz(x, y, z)


@pytest.mark.parametrize("name", ["brown_conrady", "kannala_brandt", "unified_lens", "scaramuzza"])
def test_one_camera_per_point_is_what_each_gives_alone(name, x64):
    camera = model(name)
    other = jax.tree.map(lambda leaf: 1.01 * leaf, camera)
    points = bearings_within(0.9 * MODELS[name][2])[::60]
    stack = jax.tree.map(lambda a, b: np.stack([a, b, a, b, a]), camera, other)
    u, v, x, y, z, inside = elementwise(stack, *points.T)
    alone = np.where(np.arange(5)[:, None] % 2, project(other, points), project(camera, points))
    np.testing.assert_allclose(np.stack([u, v], axis=1), alone, rtol=1e-12)
    np.testing.assert_allclose(np.stack([x, y, z], axis=1), points, atol=1e-9)
    assert inside.all()


@pytest.fixture(scope="module")
def aprilgrid(data_root):
    return data_root / "aprilgrid_corners"


REFERENCES = {
    "kb4": lambda c: KannalaBrandt(c["fx"], c["fy"], c["cx"], c["cy"], c["p1"], c["p2"], c["p3"], c["p4"]),
    "eucm": lambda c: ExtendedUnified(c["fx"], c["fy"], c["cx"], c["cy"], c["p1"], c["p2"]),
    "ds": lambda c: DoubleSphere(c["fx"], c["fy"], c["cx"], c["cy"], c["p1"], c["p2"]),
}


@pytest.mark.data
def test_reference_calibrations_of_one_camera_see_the_same_rays(aprilgrid, x64):
    grid = np.stack(np.meshgrid(np.linspace(30, 720, 20), np.linspace(30, 450, 15)), axis=-1).reshape(300, 2)
    rays = {}
    for name, build in REFERENCES.items():
        value = json.loads((aprilgrid / f"gt_calib_{name}.json").read_text())["value0"]
        rays[name] = unproject(build(value["cam.intrinsics"][0]), grid)
    # The principal points differ by hundredths of a pixel, the shapes of the models by little more.
    assert np.abs(rays["kb4"] - rays["eucm"]).max() < 1e-3
    assert np.abs(rays["ds"] - rays["eucm"]).max() < 1e-3


@pytest.mark.data
@pytest.mark.parametrize("name", REFERENCES)
def test_reference_calibration_makes_the_board_plane(name, aprilgrid, x64):
    value = json.loads((aprilgrid / f"gt_calib_{name}.json").read_text())["value0"]
    camera = REFERENCES[name](value["cam.intrinsics"][0])
    frames = json.loads((aprilgrid / "detected_corners.json").read_text())["value0"]
    residuals = []
    for frame in [entry for entry in frames if entry["key"]["second"] == 0][::13]:
        ids = np.array(frame["value"]["value1"])
        pixels = np.array([[corner["value0"], corner["value1"]] for corner in frame["value"]["value0"]])
        tag, corner = np.divmod(ids, 4)
        row, column = np.divmod(tag, 6)
        board = np.stack([column * 1.3 + np.isin(corner, (1, 2)), row * 1.3 + np.isin(corner, (2, 3))], axis=1)
        plane = normalized(camera, pixels)
        homography, _ = cv2.findHomography(board, plane, 0)
        mapped = cv2.perspectiveTransform(board[None], homography)[0]
        back = project(camera, np.pad(mapped, ((0, 0), (0, 1)), constant_values=1.0))
        residuals.append(np.linalg.norm(back - pixels, axis=1))
    residuals = np.concatenate(residuals)
    # Corners are detected to a few tenths of a pixel; a few of these detections are wrong.
    assert np.median(residuals) < 0.2
    assert len(residuals) > 200
