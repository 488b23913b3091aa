"""The bags of a robot among posts, of each kind."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the bags of the robot among posts, by kind."""
    from ros_bags import KINDS, robot_among_posts, write_bag

    folder, messages = tmp_path_factory.mktemp("bags"), robot_among_posts()
    return {kind: write_bag(folder, kind, messages) for kind in KINDS}
