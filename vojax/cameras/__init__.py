"""Camera models: points of the camera frame to pixels and back; pairs and rigs of them; and their files."""

from ._brown_conrady import BrownConrady as BrownConrady
from ._camera_set import CameraSet as CameraSet
from ._double_sphere import DoubleSphere as DoubleSphere
from ._extended_unified import ExtendedUnified as ExtendedUnified
from ._files import read_cameras as read_cameras
from ._files import write_cameras as write_cameras
from ._kannala_brandt import KannalaBrandt as KannalaBrandt
from ._pinhole import Pinhole as Pinhole
from ._protocol import Camera as Camera
from ._rectification import Rectification as Rectification
from ._rectification import rectification_maps as rectification_maps
from ._rig import Rig as Rig
from ._scaramuzza import Scaramuzza as Scaramuzza
from ._spherical import Spherical as Spherical
from ._stereo import RectifiedStereo as RectifiedStereo
from ._unified import Unified as Unified
