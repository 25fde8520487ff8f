"""Frame times that papers printed, typed out: timings to fit without a device, and to check models against."""

from tuning.published.tables import PUBLISHED, read_published

__all__ = ["PUBLISHED", "read_published"]
