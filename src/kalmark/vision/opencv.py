"""OpenCV, which the optional dependency `kalmark[opencv]` brings: what it has is here under the same names."""

from __future__ import annotations

from typing import Any

from kalmark.errors import ModelError


def __getattr__(name: str) -> Any:
    """Return what OpenCV has of a name.  Raises ModelError."""
    if name.startswith("__"):  # asked by the import of this module
        raise AttributeError(name)
    try:
        import cv2
    except ImportError:
        raise ModelError("OpenCV is not installed, expected it: pip install 'kalmark[opencv]'") from None
    return getattr(cv2, name)
