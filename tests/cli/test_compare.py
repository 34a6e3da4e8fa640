import json

import numpy as np
import pytest

from vojax.metrics import read_trajectory


@pytest.fixture
def compare(vojax_command, kitti, tmp_path):
    def compare(*pipelines, more=()):
        return vojax_command(
            "compare", kitti, "--dataset", "kitti", "--pipelines", *pipelines, "--out", tmp_path / "out", *more
        )

    return compare


def test_one_table_of_several_pipelines(compare, fake, drawn_for_real, tmp_path):
    outcome = compare("stereo-3d2d", "mono-3d2d", more=("--seed", 2, "--max-frames", 5, "--window", "off"))
    assert outcome.status == 0, outcome.stderr
    assert [(made.seed, made.options.window) for made in fake.made] == [(2, False), (2, False)]
    written = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert written["sequence"] == "07"
    stereo, mono = written["pipelines"]
    assert (stereo["pipeline"], stereo["alignment"], stereo["frames"]) == ("stereo-3d2d", "none", 5)
    assert (mono["pipeline"], mono["alignment"], mono["frames"]) == ("mono-3d2d", "sim3", 5)
    # The fake's path is straight: the error of its scale and direction is gone after alignment.
    assert stereo["ate_rmse_m"] == pytest.approx(np.hypot(0.02, 0.01) * np.sqrt(np.mean(np.arange(5) ** 2)))
    assert mono["ate_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    rows = (tmp_path / "out" / "compare.md").read_text().splitlines()
    assert rows[0] == "# 07, 5 frames"
    assert rows[2].startswith("| pipeline | alignment | ATE [m] |")
    assert rows[4].startswith(f"| stereo-3d2d | none | {stereo['ate_rmse_m']:.4f} |")
    assert rows[5].startswith("| mono-3d2d | sim3 | 0.0000 |")
    assert len(rows) == 6
    for name in ("stereo-3d2d", "mono-3d2d"):
        assert len(read_trajectory(tmp_path / "out" / name / "trajectory.txt")) == 5
        assert json.loads((tmp_path / "out" / name / "metrics.json").read_text())["pipeline"] == name
    assert (tmp_path / "out" / "compare.png").read_bytes()[:4] == b"\x89PNG"
    assert "r_rel" in outcome.stdout


def test_a_pipeline_that_fails_is_a_row(compare, fake, drawn_for_real, tmp_path, monkeypatch):
    def fail(self, k):
        if len(self.images[k - 1] if k else ()) == 2:
            raise RuntimeError("it fell\nover")

    monkeypatch.setattr(fake, "before", fail)
    outcome = compare("stereo-3d2d", "mono-3d2d")
    assert outcome.status == 0, outcome.stderr
    stereo, mono = json.loads((tmp_path / "out" / "compare.json").read_text())["pipelines"]
    assert stereo == {"pipeline": "stereo-3d2d", "error": "it fell over"}
    assert mono["error"] is None
    assert "stereo-3d2d: it fell over" in outcome.stdout
    assert "- stereo-3d2d: it fell over" in (tmp_path / "out" / "compare.md").read_text()


def test_nothing_that_ran_is_an_error(compare, fake, monkeypatch, tmp_path):
    def fail(self, k):
        raise ValueError("no light")

    monkeypatch.setattr(fake, "before", fail)
    error = compare("stereo-3d2d", "mono-2d2d").error
    assert "no pipeline ran to its end (stereo-3d2d: no light; mono-2d2d: no light)" in error
    assert not (tmp_path / "out" / "compare.json").exists()


@pytest.mark.parametrize(
    ("pipelines", "said"),
    [
        (["stereo-3d2d", "walk"], "unknown pipeline 'walk'; choose one of"),
        (["stereo-3d2d", "stereo-3d2d"], "expected one name or more, each once"),
    ],
)
def test_names_are_checked_first(compare, fake, tmp_path, pipelines, said):
    assert said in compare(*pipelines).error
    assert fake.made == []
    assert not (tmp_path / "out").exists()
