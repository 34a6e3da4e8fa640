from ._keyframes import KeyframeOptions as KeyframeOptions
from ._keyframes import is_keyframe as is_keyframe
from ._motion import MotionOptions as MotionOptions
from ._rectification import DisparityCalibration as DisparityCalibration
from ._sliding_window import WindowOptions as WindowOptions
from ._stereo import FrameEstimate as FrameEstimate
from ._stereo import StereoOdometry as StereoOdometry
from ._stereo import StereoOdometryOptions as StereoOdometryOptions

PIPELINES = {"stereo-3d2d": StereoOdometry}
