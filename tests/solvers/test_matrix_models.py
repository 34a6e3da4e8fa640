import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.solvers.problems import essential_matrices, unit_matrices
from vojax.solvers._matrix_models import perturb_essential, perturb_unit_matrix, unit_matrix

unit_of = jax.jit(unit_matrix)
move_unit = jax.jit(jax.vmap(perturb_unit_matrix))
move_essential = jax.jit(jax.vmap(perturb_essential))
unit_directions = jax.jit(jax.vmap(lambda matrix: jax.jacfwd(lambda x: perturb_unit_matrix(matrix, x))(jnp.zeros(8))))
essential_directions = jax.jit(
    jax.vmap(lambda matrix: jax.jacfwd(lambda x: perturb_essential(matrix, x))(jnp.zeros(5)))
)


def normalised(matrices, dtype):
    found, valid = unit_of(np.moveaxis(matrices, 0, -1).astype(dtype))
    return np.moveaxis(np.asarray(found, np.float64), -1, 0), np.asarray(valid)


def random_essentials(count, seed):
    rng = np.random.default_rng(seed)
    return essential_matrices(Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3)))


def special_essentials():
    """Rotations and translations along the axes, where charts like to be singular."""
    rotations = [np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])]
    rotations.append(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    directions = np.concatenate([np.eye(3), -np.eye(3), [[1.0, 1.0, 0.0], [0.0, 1.0, -1.0], [1e-9, 1e-9, -1.0]]])
    return np.stack([essential_matrices(r, t) for r in rotations for t in directions])


def test_unit_matrix_follows_the_convention(dtype):
    matrices = np.random.default_rng(0).normal(size=(500, 3, 3)) * 10.0 ** np.linspace(-6, 6, 500)[:, None, None]
    found, valid = normalised(matrices, dtype)
    assert valid.all()
    np.testing.assert_allclose(found, unit_matrices(matrices), atol=1e-6 if dtype == jnp.float32 else 1e-15)
    largest = np.take_along_axis(found.reshape(-1, 9), np.abs(found).reshape(-1, 9).argmax(axis=1)[:, None], axis=1)
    assert (largest > 0).all()


def test_unit_matrix_does_not_depend_on_scale_or_sign(dtype):
    matrices = np.random.default_rng(1).normal(size=(100, 3, 3))
    expected, _ = normalised(matrices, dtype)
    for factor in (-1.0, 1024.0, -(2.0**-20)):
        np.testing.assert_array_equal(normalised(matrices * factor, dtype)[0], expected)


def test_unit_matrix_of_nonsense_is_zero(dtype):
    matrices = np.ones((6, 3, 3))
    matrices[0] = 0.0
    matrices[1, 2, 2] = np.nan
    matrices[2, 0, 0] = np.inf
    matrices[3, 1, 1] = -np.inf
    matrices[4] *= 1e-37 if dtype == jnp.float32 else 1e-300
    found, valid = normalised(matrices, dtype)
    np.testing.assert_array_equal(valid, [False] * 5 + [True])
    np.testing.assert_array_equal(found[:5], 0.0)


def test_unit_matrix_stands_large_and_small_numbers(dtype):
    # The largest entry's square overflows, the smallest one's underflows.
    for size in (1e30, 1e-8) if dtype == jnp.float32 else (1e300, 1e-70):
        found, valid = normalised(np.array([[[size, 0.0, 0.0], [0.0, -2.0 * size, 0.0], [0.0, 0.0, 0.0]]]), dtype)
        assert valid.all()
        np.testing.assert_allclose(found[0], np.diag([-1.0, 2.0, 0.0]) / np.sqrt(5.0), atol=1e-6)


def bases(seed=2):
    """Unit matrices for charts: random, and with a first entry of one, minus one and zero."""
    rng = np.random.default_rng(seed)
    special = [np.eye(9)[i].reshape(3, 3) * s for i in range(9) for s in (1.0, -1.0)]
    return np.concatenate([unit_matrices(rng.normal(size=(100, 3, 3))), np.stack(special)])


def test_unit_chart_starts_at_the_matrix(x64):
    matrices = bases()
    np.testing.assert_array_equal(move_unit(matrices, np.zeros((len(matrices), 8))), matrices)


def test_unit_chart_stays_on_the_sphere_to_first_order(x64):
    matrices = bases()
    tangents = np.random.default_rng(3).normal(size=(len(matrices), 8))
    for step in (1e-2, 1e-4):
        moved = np.asarray(move_unit(matrices, step * tangents))
        excess = np.linalg.norm(moved, axis=(-1, -2)) - 1.0
        assert np.abs(excess).max() < step**2 * np.sum(tangents**2, axis=-1).max()


def test_unit_chart_is_an_orthonormal_basis_of_eight_directions(x64):
    matrices = bases()
    directions = np.asarray(unit_directions(matrices)).reshape(len(matrices), 9, 8)
    gram = np.einsum("bij,bik->bjk", directions, directions)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(8), gram.shape), atol=1e-14)
    along = np.einsum("bij,bi->bj", directions, matrices.reshape(-1, 9))
    assert np.abs(along).max() < 1e-14


def test_unit_chart_is_finite_at_zero(dtype):
    moved = perturb_unit_matrix(jnp.zeros((3, 3), dtype), jnp.ones(8, dtype))
    directions = jax.jacfwd(lambda x: perturb_unit_matrix(jnp.zeros((3, 3), dtype), x))(jnp.zeros(8, dtype))
    assert np.isfinite(moved).all()
    assert np.isfinite(directions).all()


@pytest.mark.parametrize("which", ["random", "special"])
def test_essential_chart_stays_on_the_manifold_to_first_order(x64, which):
    matrices = random_essentials(200, seed=4) if which == "random" else special_essentials()
    tangents = np.random.default_rng(5).normal(size=(len(matrices), 5))
    np.testing.assert_array_equal(move_essential(matrices, np.zeros((len(matrices), 5))), matrices)
    expected = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    for step in (1e-2, 1e-3, 1e-4):
        singular = np.linalg.svd(np.asarray(move_essential(matrices, step * tangents)), compute_uv=False)
        error = np.abs(singular - expected).max(axis=-1)
        assert (error < 2.0 * step**2 * np.sum(tangents**2, axis=-1)).all()


@pytest.mark.parametrize("which", ["random", "special"])
def test_essential_chart_spans_five_directions(x64, which):
    matrices = random_essentials(200, seed=6) if which == "random" else special_essentials()
    directions = np.asarray(essential_directions(matrices)).reshape(len(matrices), 9, 5)
    singular = np.linalg.svd(directions, compute_uv=False)
    assert singular.min() > 0.2
    assert singular.max() < 2.0


def test_essential_chart_spans_the_tangent_space(x64):
    # Tangents of [t]× R by differences, along rotations and directions of t, lie in the span of the chart.
    rng = np.random.default_rng(7)
    rotation, translation = Rotation.random(50, rng=rng), rng.normal(size=(50, 3))
    translation /= np.linalg.norm(translation, axis=-1, keepdims=True)

    def essential(rotation, translation):
        cross = np.swapaxes(np.cross(np.eye(3), translation[:, None, :]), -1, -2)
        return (cross @ rotation.as_matrix()) / np.sqrt(2.0)

    base = essential(rotation, translation)
    directions = np.asarray(essential_directions(base)).reshape(50, 9, 5)
    projector = directions @ np.linalg.pinv(directions)
    for axis in np.eye(3):
        turned = [essential(rotation * Rotation.from_rotvec(s * axis), translation) for s in (1e-6, -1e-6)]
        moved = [
            essential(rotation, (translation + s * axis) / np.linalg.norm(translation + s * axis, axis=-1)[:, None])
            for s in (1e-6, -1e-6)
        ]
        for ends in (turned, moved):
            change = ((ends[0] - ends[1]) / 2e-6).reshape(50, 9)
            np.testing.assert_allclose(np.einsum("bij,bj->bi", projector, change), change, atol=1e-8)


def test_essential_chart_first_turns_the_translation(x64):
    matrices = random_essentials(50, seed=8)
    null = np.linalg.svd(matrices)[0][..., 2]
    moved = np.asarray(move_essential(matrices, np.tile([1e-4, 0.0, 0.0, 0.0, 0.0], (50, 1))))
    turned = np.linalg.svd(moved)[0][..., 2]
    angle = np.arccos(np.minimum(np.abs(np.sum(null * turned, axis=-1)), 1.0))
    np.testing.assert_allclose(angle, 1e-4, rtol=1e-3)
    only_rotation = np.asarray(move_essential(matrices, np.tile([0.0, 0.0, 1e-4, -1e-4, 2e-4], (50, 1))))
    np.testing.assert_allclose(np.abs(np.sum(np.linalg.svd(only_rotation)[0][..., 2] * null, axis=-1)), 1.0, atol=1e-12)


@pytest.mark.slow
def test_essential_chart_is_finite_anywhere(dtype):
    for matrix in (np.zeros((3, 3)), np.eye(3), np.ones((3, 3)), np.diag([1.0, 0.0, 0.0])):
        matrix = jnp.asarray(matrix, dtype)
        assert np.isfinite(perturb_essential(matrix, jnp.ones(5, dtype))).all()
        assert np.isfinite(jax.jacfwd(lambda x, m=matrix: perturb_essential(m, x))(jnp.zeros(5, dtype))).all()
        assert np.isfinite(jax.jacrev(lambda m: perturb_essential(m, jnp.ones(5, dtype)))(matrix)).all()
