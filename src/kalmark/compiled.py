"""Compile the inner loops with numba and keep them on disk, in a folder named after the sources they come from.

numba checks only the file of the function itself when it looks for a stored version, not the files of what that
function calls.  The folder therefore carries a digest of all compiled sources: an edit or an upgrade starts afresh.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import platformdirs

F = TypeVar("F", bound=Callable[..., Any])


@cache
def cache_folder() -> str:
    """Return the folder of the compiled code, below ``KALMARK_CACHE`` or the user's cache."""
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for folder in ("geometry", "models", "filter"):
        for source in sorted((package / folder).glob("*.py")):
            digest.update(source.read_bytes())
    root = os.environ.get("KALMARK_CACHE") or platformdirs.user_cache_dir("kalmark")
    return str(Path(root) / "compiled" / digest.hexdigest()[:16])


def compiled(function: F) -> F:
    """Compile `function` with numba in nopython mode, cached on disk."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = before
