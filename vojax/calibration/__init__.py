"""Calibration of cameras and rigs: intrinsics, distortion and poses from views of a board, with deviations."""

from ._calibrate import Calibration as Calibration
from ._calibrate import calibrate as calibrate
from ._rig import RigCalibration as RigCalibration
from ._rig import calibrate_rig as calibrate_rig
from ._scene import SceneCalibration as SceneCalibration
from ._scene import calibrate_from_scene as calibrate_from_scene
from ._two_view_focal import SharedFocal as SharedFocal
from ._two_view_focal import estimate_shared_focal as estimate_shared_focal
from ._vanishing_points import VanishingCalibration as VanishingCalibration
from ._vanishing_points import calibrate_from_vanishing_points as calibrate_from_vanishing_points
from ._vanishing_points import vanishing_point as vanishing_point
