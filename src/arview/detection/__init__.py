"""Detection: the part found in one picture, without any earlier pose."""

from arview.detection.detector import Detection, Detector, DetectorOptions

__all__ = ["Detection", "Detector", "DetectorOptions"]
