"""From a scene to photons on the probe's pixels."""

from tapetum.simulate.budget import LinkBudget, link_budget
from tapetum.simulate.camera import Camera
from tapetum.simulate.diffuse import diffuse_return
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.exposure import count_variance, expected_counts, expose
from tapetum.simulate.gaze import gaze_of, tilt_of_gaze
from tapetum.simulate.hypotheses import sign_dprime
from tapetum.simulate.image import Image
from tapetum.simulate.information import FisherInformation, fisher
from tapetum.simulate.retroreflect import plan_scene, retroreflect
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.speckle import speckle_return

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
