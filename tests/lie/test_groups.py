import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from vojax.lie import SE3, SO3, Sim3


def exact(dtype):
    return 1e-6 if dtype is jnp.float32 else 1e-12


@functools.partial(jax.jit, static_argnums=0)
def round_trip(group, xi):
    T = group.exp(xi)
    negated = group(T.parameters().at[..., :4].multiply(-1.0))
    return T.parameters(), T.as_matrix(), T.log(), negated.log(), group.from_matrix(T.as_matrix()).as_matrix()


def test_exp_log_against_matrix_exponential(group, dtype, tangents, expm, values):
    xi = tangents(group, dtype)
    parameters, matrix, log, log_negated, again = (values(x) for x in round_trip(group, xi))
    expected = expm(xi)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(matrix / size, expected / size, rtol=0, atol=2 * exact(dtype))
    np.testing.assert_allclose(again / size, expected / size, rtol=0, atol=3 * exact(dtype))
    np.testing.assert_allclose(np.linalg.norm(parameters[:, :4], axis=1), 1.0, atol=exact(dtype))
    # φ closer to π than rounding may come back as the other sign of the axis, so compare what it stands for there.
    certain = np.linalg.norm(values(xi)[:, -4:-1] if group is Sim3 else values(xi)[:, -3:], axis=1) < 3.1415
    np.testing.assert_allclose(log[certain], values(xi)[certain], rtol=0, atol=5 * exact(dtype))
    np.testing.assert_allclose(expm(log) / size, expected / size, rtol=0, atol=5 * exact(dtype))
    np.testing.assert_allclose(log_negated, log, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("ours", "theirs"), [(SO3, jaxlie.SO3), (SE3, jaxlie.SE3)], ids=["SO3", "SE3"])
def test_agrees_with_jaxlie(ours, theirs, dtype, tangents, values):
    xi, eta = tangents(ours, dtype), tangents(ours, dtype, seed=1)[::-1]
    if ours is SE3:
        # jaxlie replaces V by R at small angles, off by θ/2 · |ρ|; those are left to the matrix exponential above.
        def clear(x):
            return np.linalg.norm(np.asarray(x)[:, 3:], axis=1) > 5e-3

        both = clear(xi) & clear(eta)
        xi, eta = xi[both], eta[both]
    points = jnp.asarray(np.random.default_rng(2).normal(size=(len(xi), 3)), dtype)

    def everything(group):
        def one(x, y, p):
            T, S = group.exp(x), group.exp(y)
            return {
                "parameters": T.parameters() * jnp.sign(T.parameters()[0]),
                "matrix": T.as_matrix(),
                "product": (T @ S).as_matrix(),
                "inverse": T.inverse().as_matrix(),
                "apply": T @ p,
                "adjoint": T.adjoint(),
                "log": (group.exp(0.3 * x) @ group.exp(0.3 * y)).log(),
                "matrix round trip": group.from_matrix(T.as_matrix()).as_matrix(),
            }

        return jax.jit(jax.vmap(one))

    found = everything(ours)(xi, eta, points)
    # The oracle always runs in float64, on the same rounded inputs.
    with jax.enable_x64(True):
        expected = everything(theirs)(*(jnp.asarray(values(x)) for x in (xi, eta, points)))
    for name, value in found.items():
        assert value.dtype == dtype, name
        np.testing.assert_allclose(values(value), values(expected[name]), rtol=0, atol=5 * exact(dtype), err_msg=name)


def test_group_axioms(group, dtype):
    keys = jax.random.split(jax.random.key(3), 4)

    @jax.jit
    def residuals(keys):
        A, B, C = (group.sample_uniform(key, (200,), dtype) for key in keys[:3])
        points = jax.random.normal(keys[3], (200, 3), dtype)
        eye, ones = group.identity((200,), dtype), jnp.zeros((200, group.tangent_dim), dtype)
        return {
            "associative": ((A @ B) @ C).as_matrix() - (A @ (B @ C)).as_matrix(),
            "left identity": (eye @ A).as_matrix() - A.as_matrix(),
            "right identity": (A @ eye).as_matrix() - A.as_matrix(),
            "left inverse": (A.inverse() @ A).as_matrix() - eye.as_matrix(),
            "right inverse": (A @ A.inverse()).as_matrix() - eye.as_matrix(),
            "action": (A @ B) @ points - A @ (B @ points),
            "exp(0)": group.exp(ones).parameters() - eye.parameters(),
            "determinant": jnp.linalg.det(A.rotation().as_matrix() if group is not SO3 else A.as_matrix()) - 1.0,
        }

    for name, residual in residuals(keys).items():
        assert residual.dtype == dtype
        assert float(jnp.abs(residual).max()) < (2e-5 if dtype is jnp.float32 else 1e-13), name


def test_adjoint_moves_tangents_across(group, dtype):
    T = group.sample_uniform(jax.random.key(4), (100,), dtype)
    xi = 0.5 * jax.random.normal(jax.random.key(5), (100, group.tangent_dim), dtype)
    moved = jax.vmap(jnp.matmul)(T.adjoint(), xi)
    left, right = (T @ group.exp(xi) @ T.inverse()).as_matrix(), group.exp(moved).as_matrix()
    np.testing.assert_allclose(left, right, rtol=0, atol=3e-5 if dtype is jnp.float32 else 1e-12)


def test_jacobians_against_central_differences(group, x64, tangents, values):
    xi = tangents(group, jnp.float64, repeats=2)
    step = 1e-6

    @jax.jit
    @jax.vmap
    def differences(x):
        T = group.exp(x)

        def left(delta):
            return (group.exp(x + delta) @ T.inverse()).log()

        def right(delta):
            return (T.inverse() @ group.exp(x + delta)).log()

        basis = step * jnp.eye(group.tangent_dim)
        return tuple(((jax.vmap(f)(basis) - jax.vmap(f)(-basis)) / (2 * step)).T for f in (left, right))

    left, right = differences(xi)
    np.testing.assert_allclose(group.jacobian_left(xi), left, rtol=0, atol=2e-9)
    np.testing.assert_allclose(group.jacobian_right(xi), right, rtol=0, atol=2e-9)


def test_jacobian_inverses(group, dtype, tangents, values):
    xi = tangents(group, dtype)
    eye = np.broadcast_to(np.eye(group.tangent_dim), (len(xi), group.tangent_dim, group.tangent_dim))
    for jacobian, inverse in (
        (group.jacobian_left, group.jacobian_left_inverse),
        (group.jacobian_right, group.jacobian_right_inverse),
    ):
        product = values(jax.jit(jacobian)(xi)) @ values(jax.jit(inverse)(xi))
        np.testing.assert_allclose(product, eye, rtol=0, atol=3e-5 if dtype is jnp.float32 else 1e-12)


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
    batched = group.exp(xi).parameters()
    looped = jnp.stack([group.exp(x).parameters() for x in xi])
    np.testing.assert_allclose(batched, looped, rtol=0, atol=5e-7)
    lanes = jax.vmap(group.exp, in_axes=-1, out_axes=-1)(xi.T)
    np.testing.assert_allclose(lanes.parameters().T, batched, rtol=0, atol=5e-7)


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
