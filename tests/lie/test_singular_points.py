import functools

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.lie import SE3, SO3, Sim3, interpolate


def everything(group, xi):
    """The functions of a tangent that have branches, in one vector."""
    T = group.exp(xi)
    parts = [
        T.parameters(),
        T.log(),
        group.from_matrix(T.as_matrix()).parameters(),
        group.jacobian_left_inverse(xi),
        interpolate(T, T, 0.3).parameters(),
        interpolate(T, T.inverse(), 0.25).parameters(),
    ]
    return jnp.concatenate([part.ravel() for part in parts])


# One shape and few compilations per group: this file would otherwise be the slowest of the folder.
@functools.cache
def compiled(group, mode):
    function = functools.partial(everything, group)
    return jax.jit(
        jax.vmap({"value": function, "forward": jax.jacfwd(function), "reverse": jax.jacrev(function)}[mode])
    )


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


# The Jacobians of everything at once take tens of seconds to compile beyond SO3; the unit-slope test below visits the
# same points of exp and log in the default run.
LONG_TO_COMPILE = [SO3, pytest.param(SE3, marks=pytest.mark.slow), pytest.param(Sim3, marks=pytest.mark.slow)]
LONG_TO_COMPILE_IDS = ["SO3", "SE3", "Sim3"]


@pytest.mark.slow
@pytest.mark.parametrize("group", LONG_TO_COMPILE, ids=LONG_TO_COMPILE_IDS)
@pytest.mark.parametrize("mode", ["value", "forward", "reverse"])
def test_finite_in_float32(group, mode):
    xi = jnp.asarray(special_tangents(group), jnp.float32)
    bad = ~np.isfinite(np.asarray(compiled(group, mode)(xi))).reshape(len(xi), -1).all(axis=1)
    assert not bad.any(), f"not finite at {np.asarray(xi)[bad][:3]}"


def away_from_half_turns(group):
    # interpolate(T, T⁻¹) doubles the angle; at half a turn the two sides of a difference may take different ways round.
    xi = special_tangents(group)
    angle = np.linalg.norm(xi[:, 3:6] if group is not SO3 else xi, axis=1)
    return np.where((angle < 1.5)[:, None], xi, 0.0)


@pytest.mark.slow
def test_slopes_against_central_differences(group, dtype):
    xi = away_from_half_turns(group).astype(dtype)
    found = {mode: np.asarray(compiled(group, mode)(xi), np.float64) for mode in ("forward", "reverse")}
    step = 1e-5
    with jax.enable_x64(True):
        value = compiled(group, "value")
        offsets = step * np.eye(group.tangent_dim)
        pairs = [
            [np.asarray(value(jnp.asarray(xi + sign * e[None], jnp.float64))) for sign in (1, -1)] for e in offsets
        ]
    expected = np.stack([(up - down) / (2 * step) for up, down in pairs], axis=-1)
    scale = max(1.0, np.abs(expected).max())
    for slope in found.values():
        np.testing.assert_allclose(slope / scale, expected / scale, atol=1e-5 if dtype is jnp.float32 else 2e-9)


def test_log_undoes_exp_with_unit_slope(group):
    # d log(exp ξ)/dξ = I all the way to half a turn.
    directions = np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.48, 0.64]])
    phi = np.concatenate([size * directions for size in (0.0, 1e-20, 1e-8, 1e-4, 0.4, 2.0, 3.0, 3.1415)])
    rest = {SO3: [phi], SE3: [phi[:, ::-1] * 0 + 0.5, phi], Sim3: [phi * 0 + 0.5, phi, phi[:, :1] * 0 + 0.2]}[group]
    xi = jnp.asarray(np.concatenate(rest, axis=1), jnp.float32)
    slope = jax.jit(jax.vmap(jax.jacfwd(lambda x: group.exp(x).log())))(xi)
    np.testing.assert_allclose(slope, np.broadcast_to(np.eye(group.tangent_dim), slope.shape), rtol=0, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("group", [SO3, SE3])
def test_second_derivatives_at_identity(group):
    def squared_distance(x):
        return 0.5 * jnp.sum(group.exp(x).log() ** 2)

    hessian = jax.jit(jax.hessian(squared_distance))(jnp.zeros(group.tangent_dim))
    np.testing.assert_allclose(hessian, np.eye(group.tangent_dim), atol=1e-6)


@hypothesis.settings(max_examples=40, deadline=None, derandomize=True)
@hypothesis.given(st.lists(st.floats(-7, 7, width=32), min_size=3, max_size=3))
def test_any_rotation_vector_is_finite(numbers):
    xi = jnp.asarray(np.broadcast_to(np.float32(numbers), special_tangents(SO3).shape))
    for mode in ("value", "reverse"):
        assert bool(jnp.isfinite(compiled(SO3, mode)(xi)[0]).all())


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
