"""Steps against the exponential that they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vojax.ba._retraction import step_pose, step_rotation, step_similarity
from vojax.lie import SE3, SO3, Sim3

KINDS = {
    "rotation": (SO3, 3, step_rotation),
    "pose": (SE3, 6, step_pose),
    "similarity": (Sim3, 7, step_similarity),
}


@pytest.mark.parametrize("kind", KINDS)
def test_first_derivatives_are_those_of_the_exponential(kind, x64):
    group, d, step = KINDS[kind]
    model = group.exp(jnp.asarray(np.random.default_rng(0).normal(size=d)))
    zero = jnp.zeros(d)
    np.testing.assert_allclose(step(model, zero).parameters(), model.parameters(), atol=1e-15)
    stepped = jax.jacfwd(lambda xi: step(model, xi).as_matrix())(zero)
    exact = jax.jacfwd(lambda xi: (group.exp(-xi) @ model).as_matrix())(zero)
    np.testing.assert_allclose(stepped, exact, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_step_of_any_size_stays_in_the_group(dtype, kind, size):
    group, d, step = KINDS[kind]
    rng = np.random.default_rng(1)
    xi = jnp.asarray(rng.normal(size=d), dtype)
    xi = xi.at[:6].multiply(size)  # the scale is exponential
    moved = step(group.exp(jnp.asarray(rng.normal(size=d), dtype)), xi)
    wxyz = np.asarray(moved.parameters()[:4], np.float64)
    assert np.isfinite(np.asarray(moved.parameters())).all()
    assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=8 * float(jnp.finfo(dtype).eps))
