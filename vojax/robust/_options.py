"""Settings of robust estimation."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class RansacOptions:
    """How many hypotheses are drawn, how they are judged and how the best are polished.

    Attributes:
        threshold_px: Largest reprojection error of an inlier, in pixels.
        threshold: Largest distance of an inlier in scene units, where points are compared with points.
        confidence: Probability with which at least one sample was free of outliers when drawing stops.
        max_hypotheses: Most minimal samples drawn. Fundamental matrices have four times as many by default: samples of
            seven are seldom free of outliers.
        chunk_size: Samples drawn and scored together. None takes what suits the solver: 128 for five points, 512 for
            the cheap ones.
        coarse_points: Observations that judge every hypothesis; all observations judge the best of them.
        survivors: Hypotheses of a chunk that all observations judge.
        top_k: Best hypotheses that local optimisation polishes.
        local_steps: Gauss–Newton steps of that optimisation.
        final_steps: Most steps of the last refinement, Levenberg–Marquardt on the inliers.
    """

    threshold_px: float = 3.0
    threshold: float = 0.05
    confidence: float = 0.999
    max_hypotheses: int = 4096
    chunk_size: int | None = None
    coarse_points: int = 128
    survivors: int = 32
    top_k: int = 4
    local_steps: int = 5
    final_steps: int = 20

    def __post_init__(self) -> None:
        for name in ("threshold_px", "threshold"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}: expected a positive number")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence is {self.confidence}: expected a probability between 0 and 1, both excluded")
        for name in (
            "max_hypotheses",
            "chunk_size",
            "coarse_points",
            "survivors",
            "top_k",
            "local_steps",
            "final_steps",
        ):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is {value}: expected at least 1")
