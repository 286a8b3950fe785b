"""The organised range image of a scan, its surface, and its files."""

from scanmap.scan.range_image import Scan, ScanParams

__all__ = ["Scan", "ScanParams"]
