"""Identity: whether the specimen in view is the one that was followed, to which labels of a serial number belong."""

from arview.tracking.identity.monitor import IdentityMonitor, IdentityResult

__all__ = ["IdentityMonitor", "IdentityResult"]
