"""Makes README's picture of the dashboard from the sample flight, at a third of its rate.

    python tests/service/dashboard_picture.py maps/atrium/dashboard.jpg

It waits for a moment of tracking without an alarm, which may take long on a busy machine.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from intake_stand import eventually
from playwright.sync_api import sync_playwright
from standing import Service

sys.path.append(str(Path(__file__).parents[1]))
from browsing import ARGUMENTS

RATE_HZ, FLOWN_MS, PATIENCE_S = 10.0, 15_000, 240.0
CALM = """!document.querySelector("#alarms").childElementCount
    && document.querySelector(".state").dataset.state === "tracking" """

with (
    tempfile.TemporaryDirectory() as folder,
    Service(Path(folder)) as service,
    service.fly("blimp-1", Path(folder), rate_hz=RATE_HZ),
    sync_playwright() as playwright,
):
    path = shutil.which("chromium")
    browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(service.url)
    page.wait_for_timeout(FLOWN_MS)
    eventually(lambda: page.evaluate(CALM), PATIENCE_S)
    page.screenshot(path=sys.argv[1], type="jpeg", quality=75)
    browser.close()
