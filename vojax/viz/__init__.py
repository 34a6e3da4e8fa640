from ._calibration import plot_calibration as plot_calibration
from ._drift import plot_drift_by_length as plot_drift_by_length
from ._figure import save_figure as save_figure
from ._residuals import plot_residuals as plot_residuals
from ._timings import plot_timings as plot_timings
from ._tracks import draw_tracks as draw_tracks
from ._trajectory import plot_trajectories as plot_trajectories
from ._trajectory import plot_trajectory as plot_trajectory
