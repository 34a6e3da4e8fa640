import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.lie import SE3, SO3, Sim3, interpolate


def everything(group, xi):
    """All functions of a tangent, in one vector."""
    T = group.exp(xi)
    parts = [
        T.parameters(),
        T.log(),
        group.from_matrix(T.as_matrix()).parameters(),
        T.inverse().parameters(),
        T.adjoint(),
        T.normalize().parameters(),
        group.jacobian_left(xi),
        group.jacobian_right_inverse(xi),
        interpolate(group.identity(dtype=xi.dtype), T, 0.3).parameters(),
        interpolate(T, T, 0.3).parameters(),
        interpolate(T, T.inverse(), 0.5).log(),
    ]
    return jnp.concatenate([part.ravel() for part in parts])


@functools.cache
def compiled(group):
    function = functools.partial(everything, group)
    return jax.jit(jax.vmap(lambda x: (function(x), jax.jacfwd(function)(x), jax.jacrev(function)(x))))


def special_tangents(group):
    e = np.eye(3)
    axis = np.array([0.6, -0.48, 0.64])
    phi = [np.zeros(3)]
    phi += [size * direction for size in (1e-4, 1e-8, 1e-20, 1e-38) for direction in (e[0], axis)]
    phi += [(np.pi + off) * direction for off in (0.0, 1e-6, -1e-6, 1e-3) for direction in (*e, axis)]
    phi += [0.4 * axis, 2.0 * axis, 4.0 * axis, 2 * np.pi * e[2], 1e12 * axis]
    phi = np.array(phi)
    rho = np.tile([0.3, -1.0, 0.5], (len(phi), 1))
    rows = []
    for sigma in (0.0, 1e-20, -1e-4, 2.0) if group is Sim3 else (0.0,):
        for r in (rho, 0 * rho):
            parts = {SO3: [phi], SE3: [r, phi], Sim3: [r, phi, np.full((len(phi), 1), sigma)]}[group]
            rows.append(np.concatenate(parts, axis=1))
    return np.concatenate(rows)


def test_values_and_gradients_finite_in_float32(group):
    xi = jnp.asarray(special_tangents(group), jnp.float32)
    for name, result in zip(("value", "forward", "reverse"), compiled(group)(xi), strict=True):
        bad = ~np.isfinite(np.asarray(result)).reshape(len(xi), -1).all(axis=1)
        assert not bad.any(), f"{name} not finite at {np.asarray(xi)[bad][:3]}"


def test_float32_gradients_match_float64(group):
    # Away from half a turn, where one float32 step of the input may choose the other sign of the axis, and whole turns.
    xi = special_tangents(group)
    angle = np.linalg.norm(xi[:, 3:6] if group is not SO3 else xi, axis=1)
    # interpolate(T, T⁻¹) doubles the angle.
    xi = np.float32(np.where((angle < 1.5)[:, None], xi, 0.0))
    single = compiled(group)(jnp.asarray(xi))
    with jax.enable_x64(True):
        double = [np.asarray(x) for x in compiled(group)(jnp.asarray(xi, jnp.float64))]
    for mine, reference in zip(single, double, strict=True):
        scale = np.maximum(1.0, np.abs(reference).max())
        np.testing.assert_allclose(np.asarray(mine) / scale, reference / scale, rtol=0, atol=1e-5)


def test_gradients_against_central_differences(group, x64):
    xi = special_tangents(group)
    angle = np.linalg.norm(xi[:, 3:6] if group is not SO3 else xi, axis=1)
    xi = jnp.asarray(xi[angle < 1.5])
    _, forward, reverse = compiled(group)(xi)
    step = 1e-5
    offsets = step * np.eye(group.tangent_dim)
    columns = []
    for offset in offsets:
        up, down = (compiled_value(group)(xi + sign * offset[None]) for sign in (1.0, -1.0))
        columns.append(np.asarray(up - down) / (2 * step))
    expected = np.stack(columns, axis=-1)
    np.testing.assert_allclose(forward, expected, rtol=1e-8, atol=3e-8)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12)


@functools.cache
def compiled_value(group):
    return jax.jit(jax.vmap(functools.partial(everything, group)))


def test_log_undoes_exp_with_unit_slope(group):
    # d log(exp ξ)/dξ = I all the way to half a turn.
    directions = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.48, 0.64]])
    phi = np.concatenate([size * directions for size in (0.0, 1e-20, 1e-8, 1e-4, 0.4, 2.0, 3.0, 3.1415)])
    rest = {SO3: [phi], SE3: [phi[:, ::-1] * 0 + 0.5, phi], Sim3: [phi * 0 + 0.5, phi, phi[:, :1] * 0 + 0.2]}[group]
    xi = jnp.asarray(np.concatenate(rest, axis=1), jnp.float32)
    slope = jax.jit(jax.vmap(jax.jacfwd(lambda x: group.exp(x).log())))(xi)
    np.testing.assert_allclose(slope, np.broadcast_to(np.eye(group.tangent_dim), slope.shape), rtol=0, atol=2e-5)


def test_second_derivatives_finite_at_identity(group):
    def cost(x):
        return jnp.sum(everything(group, x) ** 2)

    hessian = jax.jit(jax.hessian(cost))(jnp.zeros(group.tangent_dim))
    assert bool(jnp.isfinite(hessian).all())


@hypothesis.settings(max_examples=60, deadline=None, derandomize=True)
@hypothesis.given(st.lists(st.floats(-7, 7, width=32), min_size=7, max_size=7))
def test_any_tangent_is_finite(numbers):
    for group in (SO3, SE3, Sim3):
        xi = jnp.asarray(numbers[-group.tangent_dim :], jnp.float32)
        for result in compiled(group)(xi[None]):
            assert bool(jnp.isfinite(result).all())


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [-1e-20, 0, 0, 1]])
def test_log_of_special_quaternions(quaternion):
    R = SO3(jnp.asarray(quaternion, jnp.float32))
    log, slope = R.log(), jax.jacrev(lambda q: SO3(q).log())(R.wxyz)
    angle = 0.0 if abs(quaternion[0]) == 1 or not any(quaternion) else np.pi
    np.testing.assert_allclose(np.linalg.norm(log), angle, rtol=1e-6)
    assert bool(jnp.isfinite(slope).all())


def test_from_matrix_gradient_for_all_rotations(x64):
    # Along the group, d/dδ of log(R⁻¹ from_matrix(R exp δ)) is the identity whichever row was selected.
    R = SO3.sample_uniform(jax.random.key(0), (300,))
    half_turns = SO3.exp(jnp.pi * jnp.eye(3))
    R = SO3(jnp.concatenate([R.wxyz, half_turns.wxyz]))

    @jax.jit
    @jax.vmap
    def slope(wxyz):
        rotation = SO3(wxyz)

        def moved(delta):
            return (rotation.inverse() @ SO3.from_matrix((rotation @ SO3.exp(delta)).as_matrix())).log()

        return jax.jacrev(moved)(jnp.zeros(3))

    found = slope(R.wxyz)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(3), found.shape), atol=1e-12)
