"""The study of drift with and without a window in its small mode: drives of 100 m."""

import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

STUDY = pathlib.Path(__file__).parents[2] / "benchmarks" / "study_windowed_drift.py"


@pytest.mark.slow
def test_windows_that_remember_drift_least_in_both_precisions():
    spec = importlib.util.spec_from_file_location("study_windowed_drift", STUDY)
    assert spec is not None
    assert spec.loader is not None
    study = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(study)
    with jax.enable_x64(True):
        drives = study.draw(seeds=8, frames=51, step=2.0)
        double = study.end_errors(drives, 2.0, jnp.float64)
        single = study.end_errors(drives, 2.0, jnp.float32)
    points_exact, frame_to_frame, forgetful, remembering = (study.rms(error) for error in double)
    assert frame_to_frame < points_exact
    assert remembering < frame_to_frame
    assert remembering < 0.8 * points_exact
    # Without the landmarks that began before it, a window knows less of its first motion than two frames do.
    assert remembering < 0.8 * forgetful
    for one, two in zip(single, double, strict=True):
        np.testing.assert_allclose(study.rms(one), study.rms(two), rtol=0.01)
