"""Camera models: points of the camera frame to pixels and back."""

from ._brown_conrady import BrownConrady as BrownConrady
from ._pinhole import Pinhole as Pinhole
from ._protocol import Camera as Camera
from ._rig import Rig as Rig
from ._stereo import RectifiedStereo as RectifiedStereo
