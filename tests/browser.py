"""A page in a browser: the JSON that its script leaves as the title."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def said_by_page(page: str, folder: Path, *options: str) -> Any:
    """Return the title of a page in Chromium, None if its script did not end; skip the test without Chromium."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium to open the page with")
    (folder / "page.html").write_text(page)
    # Without a graphics card a quarter of the pixels, in the same layout, is drawn in half of the time
    command = [chromium, "--headless", "--no-sandbox", "--dump-dom", "--force-device-scale-factor=0.5"]
    command += [*options, f"file://{folder}/page.html"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False).stdout
    found = re.search(r"<title>({.*?})</title>", shown)
    return None if found is None else json.loads(found[1])
