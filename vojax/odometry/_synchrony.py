"""Whether left and right were taken at the same time, told by the rows of their matches.

A right image that is taken a share δ of the frame interval late sees each point where the left one will see it by then:
of a feature that moves down by f pixels a frame, the match lies δ f pixels lower than the row. Rectification leaves row
offsets too, but these are a function of the pixel, whatever moves there. So the offsets are fitted by δ f + a + b u +
c v, over all frames so far. Plain numpy.
"""

from typing import NamedTuple

import numpy as np

from vojax._types import Float

# A feature is measured in frame after frame with much the same error: each of its measurements counts half.
_EVIDENCE_SHARE = 0.5
# Row offsets of matches scatter by less, px; larger ones lose their weight as under a Cauchy loss.
_SIGMA_PX = 0.5


class Synchrony(NamedTuple):
    """What is known of (δ, a, b, c): normal equations.

    Attributes:
        information: Inverse covariance, of coefficients of pixels.
        vector: Information times the estimate.
    """

    information: Float[np.ndarray, "4 4"]
    vector: Float[np.ndarray, "4"]

    @classmethod
    def prior(cls) -> "Synchrony":
        """Before any frame: at the same time, to one frame; an offset of a pixel, over a thousand pixels too."""
        return cls(np.eye(4), np.zeros(4))

    def add(
        self, pixels: Float[np.ndarray, "n 2"], flow: Float[np.ndarray, "n"], row_offset: Float[np.ndarray, "n"]
    ) -> "Synchrony":
        """Add a frame's evidence.

        Args:
            pixels: Of features of the left image that belong to the motion.
            flow: How far each moved down since the frame before, px.
            row_offset: v_right − v_left of its match, px.
        """
        u, v = np.asarray(pixels, float).T / 1000.0
        terms = np.stack([np.asarray(flow, float), np.ones_like(u), u, v], axis=1)
        residual = row_offset - terms @ np.linalg.solve(self.information, self.vector)
        weight = _EVIDENCE_SHARE / (_SIGMA_PX**2 + residual**2)
        weighted = terms * weight[:, None]
        return Synchrony(self.information + terms.T @ weighted, self.vector + weighted.T @ row_offset)

    def late(self) -> tuple[float, float]:
        """δ, positive where the right image is the later one, in frame intervals; and its standard deviation."""
        covariance = np.linalg.inv(self.information)
        return float((covariance @ self.vector)[0]), float(covariance[0, 0] ** 0.5)
