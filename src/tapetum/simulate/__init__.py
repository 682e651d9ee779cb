"""From a scene to photons on the probe's pixels."""

from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.exposure import expose
from tapetum.simulate.hypotheses import sign_dprime
from tapetum.simulate.image import Image
from tapetum.simulate.retroreflect import Camera, gaze_of, plan_scene, retroreflect, tilt_of_gaze

__all__ = [
    "Camera",
    "DoublePass",
    "Image",
    "expose",
    "gaze_of",
    "plan_scene",
    "retroreflect",
    "sign_dprime",
    "tilt_of_gaze",
]
