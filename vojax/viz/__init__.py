from ._calibration import plot_calibration as plot_calibration
from ._figure import save_figure as save_figure
from ._residuals import plot_residuals as plot_residuals
from ._tracks import draw_tracks as draw_tracks
from ._trajectory import plot_trajectory as plot_trajectory
