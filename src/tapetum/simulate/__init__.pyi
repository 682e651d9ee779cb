from .budget import LinkBudget, link_budget
from .camera import Camera
from .diffuse import diffuse_return
from .double_pass import DoublePass
from .exposure import count_variance, expected_counts, expose
from .gaze import gaze_of, tilt_of_gaze
from .hypotheses import sign_dprime
from .image import Image
from .information import FisherInformation, fisher
from .retroreflect import plan_scene, retroreflect
from .round_pass import RoundPass
from .speckle import speckle_return

__all__ = [
    "Camera",
    "DoublePass",
    "FisherInformation",
    "Image",
    "LinkBudget",
    "RoundPass",
    "count_variance",
    "diffuse_return",
    "expected_counts",
    "expose",
    "fisher",
    "gaze_of",
    "link_budget",
    "plan_scene",
    "retroreflect",
    "sign_dprime",
    "speckle_return",
    "tilt_of_gaze",
]
