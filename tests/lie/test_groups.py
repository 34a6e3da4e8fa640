import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from vojax.lie import SE3, SO3, Sim3


def exact(dtype):
    return 1e-6 if dtype is jnp.float32 else 1e-12


def run(function, *arguments):
    """Compiled call. One operation at a time and one shape: a chain of them compiles for much longer than its parts."""
    return jax.jit(function)(*arguments)


def test_exp_log_against_matrix_exponential(group, dtype, tangents, expm, values):
    xi = tangents(group, dtype)
    T = run(group.exp, xi)
    matrix, log = run(group.as_matrix, T), values(run(group.log, T))
    negated = values(run(group.log, group(T.parameters().at[..., :4].multiply(-1.0))))
    again = values(run(group.as_matrix, run(group.from_matrix, matrix)))
    expected = expm(xi)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(values(matrix) / size, expected / size, rtol=0, atol=2 * exact(dtype))
    np.testing.assert_allclose(again / size, expected / size, rtol=0, atol=3 * exact(dtype))
    np.testing.assert_allclose(np.linalg.norm(values(T.parameters())[:, :4], axis=1), 1.0, atol=exact(dtype))
    # φ closer to π than rounding may come back as the other sign of the axis, so compare what it stands for there.
    certain = np.linalg.norm(values(xi)[:, -4:-1] if group is Sim3 else values(xi)[:, -3:], axis=1) < 3.1415
    np.testing.assert_allclose(log[certain], values(xi)[certain], rtol=0, atol=5 * exact(dtype))
    np.testing.assert_allclose(expm(log) / size, expected / size, rtol=0, atol=5 * exact(dtype))
    np.testing.assert_allclose(negated, log, rtol=0, atol=exact(dtype))


@functools.cache
def jaxlie_answers(group, count):
    """What jaxlie says in float64 about the inputs below, and those inputs."""
    rng = np.random.default_rng(2)
    phi = rng.normal(size=(2, count, 3))
    # Angles from 5e-3 to 3.1: below 3e-3 (float32) jaxlie's SE3 replaces V by R, off by θ/2 · |ρ|. The matrix
    # exponential above covers those.
    phi *= np.geomspace(5e-3, 3.1, count)[None, :, None] / np.linalg.norm(phi, axis=-1, keepdims=True)
    tangents = phi if group is jaxlie.SO3 else np.concatenate([rng.normal(size=phi.shape), phi], axis=-1)
    x, y, p = (v.astype(np.float32) for v in (tangents[0], tangents[1, ::-1], rng.normal(size=(count, 3))))
    with jax.enable_x64(True):
        T, S = (jax.vmap(group.exp)(jnp.asarray(v, jnp.float64)) for v in (x, y))
        product = jax.vmap(group.multiply)(T, S)
        answers = {
            "parameters": T.parameters(),
            "matrix": jax.vmap(group.as_matrix)(T),
            "product": jax.vmap(group.as_matrix)(product),
            "inverse": jax.vmap(group.as_matrix)(jax.vmap(group.inverse)(T)),
            "apply": jax.vmap(group.apply)(T, jnp.asarray(p, jnp.float64)),
            "adjoint": jax.vmap(group.adjoint)(T),
            "log": jax.vmap(group.log)(T),
        }
        return (x, y, p), {name: np.asarray(answer) for name, answer in answers.items()}


@pytest.mark.parametrize(("ours", "theirs"), [(SO3, jaxlie.SO3), (SE3, jaxlie.SE3)], ids=["SO3", "SE3"])
def test_agrees_with_jaxlie(ours, theirs, dtype, values):
    inputs, expected = jaxlie_answers(theirs, 52)
    x, y, p = (jnp.asarray(v, dtype) for v in inputs)
    T, S = run(ours.exp, x), run(ours.exp, y)
    found = {
        "parameters": T.parameters(),
        "matrix": run(ours.as_matrix, T),
        "product": run(ours.as_matrix, run(ours.multiply, T, S)),
        "inverse": run(ours.as_matrix, run(ours.inverse, T)),
        "apply": run(ours.apply, T, p),
        "adjoint": run(ours.adjoint, T),
        "log": run(ours.log, T),
    }
    assert found.keys() == expected.keys()
    for name, value in found.items():
        assert value.dtype == dtype, name
        np.testing.assert_allclose(values(value), expected[name], rtol=0, atol=5 * exact(dtype), err_msg=name)


def test_group_axioms(group, dtype):
    keys = jax.random.split(jax.random.key(3), 4)
    A, B, C = (group.sample_uniform(key, (52,), dtype) for key in keys[:3])
    points = jax.random.normal(keys[3], (52, 3), dtype)
    eye = group.identity((52,), dtype)

    def times(X, Y):
        return run(group.multiply, X, Y)

    inverse = run(group.inverse, A)
    pairs = {
        "associative": (times(times(A, B), C), times(A, times(B, C))),
        "left identity": (times(eye, A), A),
        "right identity": (times(A, eye), A),
        "left inverse": (times(inverse, A), eye),
        "right inverse": (times(A, inverse), eye),
        "exp(0)": (run(group.exp, jnp.zeros((52, group.tangent_dim), dtype)), eye),
    }
    tolerance = 2e-5 if dtype is jnp.float32 else 1e-13
    for name, (X, Y) in pairs.items():
        left, right = run(group.as_matrix, X), run(group.as_matrix, Y)
        assert left.dtype == dtype
        np.testing.assert_allclose(left, right, rtol=0, atol=tolerance, err_msg=name)
    moved = run(group.apply, times(A, B), points)
    np.testing.assert_allclose(moved, run(group.apply, A, run(group.apply, B, points)), rtol=0, atol=tolerance)
    R = np.asarray((A if group is SO3 else A.rotation()).as_matrix(), np.float64)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=0, atol=tolerance)


def test_adjoint_moves_tangents_across(group, dtype):
    T = group.sample_uniform(jax.random.key(4), (52,), dtype)
    xi = 0.5 * jax.random.normal(jax.random.key(5), (52, group.tangent_dim), dtype)
    moved = jax.vmap(jnp.matmul)(run(group.adjoint, T), xi)
    conjugate = run(group.multiply, run(group.multiply, T, run(group.exp, xi)), run(group.inverse, T))
    left, right = run(group.as_matrix, conjugate), run(group.as_matrix, run(group.exp, moved))
    np.testing.assert_allclose(left, right, rtol=0, atol=3e-5 if dtype is jnp.float32 else 1e-12)


@pytest.mark.slow
def test_jacobians_against_central_differences(group, x64, tangents):
    xi, step = tangents(group, jnp.float64), 1e-6
    T = run(group.exp, xi)
    inverse = run(group.inverse, T)
    left, right = [], []
    for offset in step * np.eye(group.tangent_dim):
        ends = [run(group.exp, xi + sign * offset[None]) for sign in (1.0, -1.0)]
        lefts = [run(group.log, run(group.multiply, end, inverse)) for end in ends]
        rights = [run(group.log, run(group.multiply, inverse, end)) for end in ends]
        left.append((lefts[0] - lefts[1]) / (2 * step))
        right.append((rights[0] - rights[1]) / (2 * step))
    np.testing.assert_allclose(run(group.jacobian_left, xi), np.stack(left, axis=-1), rtol=0, atol=5e-9)
    np.testing.assert_allclose(run(group.jacobian_right, xi), np.stack(right, axis=-1), rtol=0, atol=5e-9)


@pytest.mark.slow
def test_jacobian_inverses(group, dtype, tangents, values):
    xi = tangents(group, dtype)
    eye = np.broadcast_to(np.eye(group.tangent_dim), (len(xi), group.tangent_dim, group.tangent_dim))
    for jacobian, inverse in (
        (group.jacobian_left, group.jacobian_left_inverse),
        (group.jacobian_right, group.jacobian_right_inverse),
    ):
        product = values(run(jacobian, xi)) @ values(run(inverse, xi))
        np.testing.assert_allclose(product, eye, rtol=0, atol=3e-5 if dtype is jnp.float32 else 1e-12)


@pytest.mark.slow
def test_leading_axes_broadcast(group, values):
    T = group.sample_uniform(jax.random.key(6), (4, 1))
    S = group.sample_uniform(jax.random.key(7), (5,))
    points = jax.random.normal(jax.random.key(8), (3, 1, 5, 3))
    product, moved = T @ S, T @ points
    assert product.get_batch_axes() == (4, 5)
    assert moved.shape == (3, 4, 5, 3)
    matrices, others = values(T.as_matrix()), values(S.as_matrix())
    np.testing.assert_allclose(product.as_matrix(), np.einsum("aoij,bjk->abik", matrices, others), atol=2e-6)
    linear = matrices[..., :3, :3]
    offset = matrices[..., :3, 3] if group is not SO3 else np.zeros((4, 1, 3))
    expected = np.einsum("aoij,soBj->saBi", linear, values(points)) + offset[None]
    np.testing.assert_allclose(moved, expected, atol=2e-6)
    one = group.sample_uniform(jax.random.key(9))
    assert (one @ points).shape == (3, 1, 5, 3)
    assert (T @ np.ones(3, np.float32)).shape == (4, 1, 3)
    assert (one @ S).get_batch_axes() == (5,)
    assert (S @ one).get_batch_axes() == (5,)


def test_batch_equals_loop_and_last_axis(group, tangents):
    xi = tangents(group, jnp.float32, repeats=1)
    exp = jax.jit(lambda x: group.exp(x).parameters())
    batched = exp(xi)
    tolerance = 1e-6 * float(jnp.abs(batched).max())
    np.testing.assert_allclose(batched, jnp.stack([exp(x) for x in xi]), rtol=0, atol=tolerance)
    lanes = jax.jit(jax.vmap(exp, in_axes=-1, out_axes=-1))(xi.T)
    np.testing.assert_allclose(lanes.T, batched, rtol=0, atol=tolerance)


def test_from_matrix_for_every_largest_component(dtype):
    # Half turns and near half turns about each axis and between them reach all four of Shepperd's rows.
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, -1, 1]], np.float64)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (0.0, 1e-6, 2.0, 2 * np.pi / 3, np.pi - 1e-6, np.pi):
        R = SO3.exp(jnp.asarray(angle * axes, dtype)).as_matrix()
        q = SO3.from_matrix(R)
        np.testing.assert_allclose(q.as_matrix(), R, rtol=0, atol=2 * exact(dtype))
        np.testing.assert_allclose(jnp.linalg.norm(q.wxyz, axis=1), 1.0, rtol=exact(dtype))


def test_accessors_and_constructors():
    rotation = SO3.sample_uniform(jax.random.key(0), (6,))
    translation = jnp.arange(3.0)
    pose = SE3.from_rotation_and_translation(rotation, translation)
    np.testing.assert_array_equal(pose.rotation().wxyz, rotation.wxyz)
    np.testing.assert_array_equal(pose.translation(), np.tile(np.arange(3.0), (6, 1)))
    similarity = Sim3.from_rotation_translation_scale(rotation, translation, 2.0)
    np.testing.assert_array_equal(similarity.scale(), np.full(6, 2.0))
    p = np.array([1.0, -2.0, 0.5], np.float32)
    np.testing.assert_allclose(similarity @ p, 2.0 * (rotation @ p) + translation[None], atol=1e-6)
    assert SE3.identity((2, 3)).get_batch_axes() == (2, 3)
    assert SO3(np.array([1, 0, 0, 0])).wxyz.dtype == jnp.float32


def test_normalize_restores_unit_quaternions(group):
    T = group.sample_uniform(jax.random.key(10), (5,))
    stretched = group(T.parameters().at[:, :4].multiply(1.7))
    np.testing.assert_allclose(stretched.normalize().parameters(), T.parameters(), atol=1e-6)
    zero = group(jnp.zeros(group.parameters_dim)).normalize().parameters()
    np.testing.assert_array_equal(zero[:4], [1.0, 0.0, 0.0, 0.0])


def test_samples_are_uniform():
    # Under the uniform law E[R] = 0 and the angle has density (1 − cos θ)/π, so E[trace R] = 0 and E[θ] = π/2 + 2/π.
    R = SO3.sample_uniform(jax.random.key(11), (40_000,))
    assert float(jnp.abs(R.as_matrix().mean(axis=0)).max()) < 0.015
    assert abs(float(jnp.linalg.norm(R.log(), axis=1).mean()) - (np.pi / 2 + 2 / np.pi)) < 0.02


def test_wrong_sizes_are_refused(group):
    with pytest.raises(ValueError, match=rf"shape \(3, 2\); expected \[\.\.\., {group.parameters_dim}\]"):
        group(jnp.zeros((3, 2)))
