"""`vojax bench`: what it says, writes and refuses. Not how fast anything is."""

import inspect
import json

import jax
import pytest

import vojax
from vojax import solvers
from vojax.cli import main
from vojax.cli._bench_robust import SHARES, estimators
from vojax.cli._bench_solvers import problems


def test_one_solver_is_measured_in_both_precisions(tmp_path, capsys):
    file = tmp_path / "bench.json"
    assert main(["bench", "solvers", "--batch", "64", "--only", "homography_four", "--json", str(file)]) == 0
    assert "homography_four_point" in capsys.readouterr().out
    written = json.loads(file.read_text())
    assert [(row["name"], row["dtype"]) for row in written["rows"]] == [
        ("homography_four_point", "float32"),
        ("homography_four_point", "float64"),
    ]
    for row in written["rows"]:
        assert 0 < row["best"] <= row["nanoseconds"]
        assert row["compile_seconds"] > 0
    assert written["batch"] == 64
    assert written["versions"]["jax"]


def test_every_minimal_solver_is_in_the_table():
    named = {name.split(",")[0] for name in problems(2)}
    takes_points = {
        name
        for name, value in vars(solvers).items()
        if inspect.isfunction(value)
        and {"rays0", "ray0", "pixels0", "bearings"} & inspect.signature(value).parameters.keys()
    }
    helpers = {"one_point_histogram", "dlt_pnp", "select_by_fourth_point", "select_by_second_p3p"}
    assert takes_points - named <= helpers


def test_every_robust_estimator_is_in_the_table():
    facades = {name.removeprefix("estimate_") for name in dir(vojax) if name.startswith("estimate_")}
    assert facades == set(estimators())


@pytest.mark.slow
def test_one_estimator_is_measured(tmp_path, capsys):
    file = tmp_path / "bench.json"
    assert main(["bench", "robust", "--batch", "4", "--only", "rigid", "--json", str(file)]) == 0
    assert "rigid" in capsys.readouterr().out
    written = json.loads(file.read_text())
    assert [(row["name"], row["outliers"]) for row in written["rows"]] == [("rigid", share) for share in SHARES]
    for row in written["rows"]:
        assert min(row["milliseconds"], row["batched"], row["compile_seconds"]) > 0
        assert row["success"] == 1.0


def test_one_adjustment_is_measured(tmp_path, capsys):
    file = tmp_path / "bench.json"
    assert main(["bench", "ba", "--batch", "2", "--only", "poses", "--json", str(file)]) == 0
    assert "poses of 100 points" in capsys.readouterr().out
    (row,) = json.loads(file.read_text())["rows"]
    assert (row["batch"], row["observations"]) == (2, 100)
    assert row["milliseconds"] > 0
    assert row["iterations"] > 1


@pytest.mark.slow
def test_every_adjustment_is_measured(capsys):
    assert main(["bench", "ba", "--batch", "4"]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("windows of 6", "stereo window of 10", "bundle of 50", "float64"))


@pytest.mark.slow
def test_one_pipeline_is_measured(tmp_path, capsys):
    file = tmp_path / "bench.json"
    assert main(["bench", "vo", "--batch", "20", "--only", "stereo-3d2d", "--json", str(file)]) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert (row["name"], row["frames"], row["bridged"]) == ("stereo-3d2d", 20, 0)
    assert row["frames_per_second"] > 0
    assert row["drift_percent"] < 2


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(estimators()))
def test_problems_of_the_table_can_be_solved(name):
    estimator = estimators()[name]
    key = jax.random.key(1)
    assert estimator.estimate(*estimator.problem(key, 100, 0.3), key).result == vojax.Result.success


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["solvers", "--batch", "0"], "batch is 0"),
        (["solvers", "--only", "no_such_solver"], "no_such_solver"),
        (["robust", "--only", "no_such_estimator"], "no_such_estimator"),
        (["ba", "--only", "no_such_problem"], "no_such_problem"),
        (["vo", "--only", "no_such_pipeline"], "no_such_pipeline"),
        (["everything"], "expected one of 'solvers'"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    assert main(["bench", *arguments]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert len(captured.err.strip().splitlines()) == 1
