from ._interpolation import cumulative_compose as cumulative_compose
from ._interpolation import interpolate as interpolate
from ._se3 import SE3 as SE3
from ._sim3 import Sim3 as Sim3
from ._so3 import SO3 as SO3
