"""One image: the detected pose is good enough to report a missing component, and reports none on a right assembly."""

from __future__ import annotations

import pytest

from arview.assembly.monitor import AssemblyMonitor
from arview.cad.model import make_model
from arview.detection import Detector
from helpers.synthetic import CAMERA, assembly, assembly_views, picture, pose_from


@pytest.mark.slow
def test_a_missing_component_is_reported_at_a_detected_pose() -> None:
    detector = Detector(assembly_views(), CAMERA)
    monitor = AssemblyMonitor(assembly_views(), CAMERA, assembly())
    without_post = make_model("look-alike", tuple(p for p in assembly().components if p.name != "post_3"))
    right, reported = [], 0
    for k in range(5):
        truth = pose_from(-60.0 + 30.0 * k, 45.0, 480.0, roll_deg=5.0 * k)
        image, faulty = (picture(truth, model, seed=k, scene=k) for model in (assembly(), without_post))
        right += [monitor.mismatches_in(image, d.cam_from_model) for d in detector.detect(image, max_results=1)]
        for found in detector.detect(faulty, max_results=1):
            mismatches = monitor.mismatches_in(faulty, found.cam_from_model)
            reported += mismatches == ("mismatch: post_3 not seen where expected",)
    assert right == [()] * 5
    assert reported >= 4
