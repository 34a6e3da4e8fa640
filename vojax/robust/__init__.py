from ._absolute_pose import estimate_absolute_pose as estimate_absolute_pose
from ._estimate import Estimate as Estimate
from ._options import RansacOptions as RansacOptions
from ._sampling import required_hypotheses as required_hypotheses
