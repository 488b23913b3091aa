"""Landmarks in images, searched where the filter expects them."""

from kalmark.vision.front_end import ActiveSearch

__all__ = ["ActiveSearch"]
