from ._candidates import Candidates as Candidates
from ._implicit import implicit as implicit
from ._implicit import perturb_camera as perturb_camera
from ._p3p import p3p as p3p
from ._procrustes import procrustes as procrustes
from ._umeyama import umeyama as umeyama
