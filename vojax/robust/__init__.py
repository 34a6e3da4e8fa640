from ._absolute_pose import AbsolutePoseEstimator as AbsolutePoseEstimator
from ._absolute_pose import estimate_absolute_pose as estimate_absolute_pose
from ._absolute_pose import search_absolute_pose as search_absolute_pose
from ._engine import Consensus as Consensus
from ._estimate import Estimate as Estimate
from ._options import RansacOptions as RansacOptions
from ._sampling import required_hypotheses as required_hypotheses
from ._scoring import msac_scores as msac_scores
