"""OpenCV, which the optional dependency `kalmark[opencv]` brings."""

from __future__ import annotations

from typing import Any

from kalmark.errors import ModelError


def opencv() -> Any:
    """Return OpenCV, on one thread.  Raises ModelError."""
    try:
        import cv2
    except ImportError:
        raise ModelError(
            "OpenCV, which searches images, is not installed, expected it: pip install 'kalmark[opencv]'"
        ) from None
    cv2.setNumThreads(1)
    return cv2
