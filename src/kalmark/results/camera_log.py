"""The log of a run's cameras, which is read again if needed, as the plug-in `vision` shows it."""

from __future__ import annotations

from contextlib import suppress
from copy import deepcopy
from typing import Any

from kalmark.config.reading import config_of
from kalmark.config.tree import Tree
from kalmark.errors import KalmarkError
from kalmark.plugins import entry_points_of, load
from kalmark.results.recording import Recording


def images_of_cameras(run: Recording) -> Any | None:
    """Return the images that the cameras of a run took: a `kalmark.vision.CameraImages` of its log.

    None of a run without cameras, where the log is not there any more, or without the plug-in.
    """
    log = run.source or _read_again(run) if run.history.cameras else None
    with suppress(KalmarkError):
        return None if log is None else load("names", "vision").CameraImages(log, run.history)
    return None


def _read_again(run: Recording) -> Any:
    """Return the log of a run that was loaded, None if no camera of it has a detector, or the log is not there."""
    searched = any(run.section(camera.robot, camera.sensor).get("detector") for camera in run.history.cameras)
    if not searched:
        return None
    from kalmark.results.batch import log_of_run  # heavy, and seldom needed

    log: Any = None
    with suppress(KalmarkError):
        log = log_of_run(run)
        config = config_of(Tree(deepcopy(dict(run.config))), None)
        for name in entry_points_of("keys"):
            log = load("keys", name).with_events(config, log)
    return log
