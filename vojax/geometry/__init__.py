"""Pure algebra of views: errors, epipolar matrices and triangulation."""

from ._epipolar import essential_from_fundamental as essential_from_fundamental
from ._epipolar import essential_from_pose as essential_from_pose
from ._epipolar import fundamental_from_essential as fundamental_from_essential
from ._epipolar import projection_matrix as projection_matrix
from ._errors import algebraic_error as algebraic_error
from ._errors import reprojection_error as reprojection_error
from ._errors import sampson_error as sampson_error
from ._errors import sampson_residual as sampson_residual
from ._errors import symmetric_epipolar_error as symmetric_epipolar_error
from ._linear_triangulation import ray_distance_std as ray_distance_std
from ._linear_triangulation import ray_distances as ray_distances
from ._linear_triangulation import triangulate_dlt as triangulate_dlt
from ._linear_triangulation import triangulate_dlt_homogeneous as triangulate_dlt_homogeneous
from ._linear_triangulation import triangulate_dlt_inhomogeneous as triangulate_dlt_inhomogeneous
from ._linear_triangulation import triangulate_rays as triangulate_rays
from ._refined_triangulation import Triangulation as Triangulation
from ._refined_triangulation import TriangulationOptions as TriangulationOptions
from ._refined_triangulation import triangulate_refine as triangulate_refine
from ._stereo import triangulate_rectified as triangulate_rectified
