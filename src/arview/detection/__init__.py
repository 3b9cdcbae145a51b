"""Detection of a part in a single image, without an earlier pose."""

from arview.detection.detector import Detection, Detector, DetectorOptions

__all__ = ["Detection", "Detector", "DetectorOptions"]
