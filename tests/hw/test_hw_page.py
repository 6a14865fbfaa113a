"""The page and its drawings are the program's output, and the drawings can be seen."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
from matplotlib.image import imread

from hw import tables
from hw.builds import shipped_builds
from hw.quantities import HardwareError
from hw.wiring import GAUGES, WIRING_FILE, drawing, load_wiring, variant_of
from pi_firmware.wire.errors import BlimpError

# The 40-pin header of every Pi since the B+: what stands at the pins that are used.
HEADER = {
    "1": "3V3", "2": "5V", "3": "SDA", "4": "5V", "5": "SCL", "6": "GND", "8": "tx", "9": "GND",
    "10": "rx", "14": "GND",
}  # fmt: skip


def test_the_pages_tables_are_the_programs() -> None:
    page = tables.PAGE.read_text(encoding="utf-8")
    # Numbers that follow from CoolProp may differ in the last digit between its versions; the
    # lock fixes one.
    assert tables.filled(page) == page, "run: python -m hw budget --write-readme"


def test_a_page_without_a_marker_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "sections", lambda: {"erratum": "| a |"})
    page = tables.PAGE.read_text(encoding="utf-8").replace("<!-- /erratum -->", "")
    with pytest.raises(HardwareError, match=r"'erratum' is marked 0 times; allowed: 1"):
        tables.filled(page)


def test_the_drawings_are_the_programs() -> None:
    for path, text in tables.drawings().items():
        assert path.read_text(encoding="utf-8") == text, "run: python -m hw budget --write-readme"


@pytest.mark.parametrize("gauge", GAUGES)
@pytest.mark.parametrize("autopilot", [True, False])
def test_the_pis_pins_are_the_headers_and_everything_is_connected(
    gauge: str, autopilot: bool
) -> None:
    wiring = load_wiring(gauge, autopilot)
    for name, pin in wiring.pins.items():
        device, _, number = name.partition(".")
        if device == "pi" and number != "csi":
            assert pin.kind == HEADER[number] and number in pin.label.split()
    ends = {end for wire in wiring.wires for end in wire.ends}
    assert {"pi.2", "pi.6", "pi.3", "pi.5", "pi.1", "pi.csi"} <= ends
    for device in wiring.devices:
        loose = {n for n in wiring.pins if n.startswith(device.id + ".")} - ends
        assert not loose or (device.id == "pi" and not autopilot), loose
    texts = ElementTree.fromstring(drawing(gauge, autopilot)).iter(
        "{http://www.w3.org/2000/svg}text"
    )
    shown = {text.text for text in texts}
    assert {"LiPo 1S", "5 V boost", gauge.upper(), "Camera Module"} <= shown
    assert ("Autopilot" in shown) == autopilot


def test_each_build_has_its_drawing() -> None:
    for build in shipped_builds().builds.values():
        gauge, autopilot = variant_of(build)
        assert gauge in build.name or build.name == "atrium"
        assert autopilot == build.name.endswith("autopilot")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('ends = ["boost.out", "pi.2"]', 'ends = ["boost.out", "pi.1"]', "joins 3V3 and 5V"),
        ('ends = ["boost.out", "pi.2"]', 'ends = ["boost.out", "pi.7"]', "there is no pin 'pi.7'"),
        ('ends = ["boost.out", "pi.2"]', 'ends = ["boost.out", "moon.2"]', "a device that is not"),
        ('"csi, left, CSI 15-way, CSI"', '"csi, left, CSI"', "allowed: id, left|right, label"),
        ("column = 4", "column = 7", "'column' is 7; allowed: 0 to 4"),
    ],
)
def test_a_wire_that_cannot_be_is_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = WIRING_FILE.read_text()
    assert old in text
    path = tmp_path / "wiring.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(BlimpError) as caught:
        load_wiring("max17048", True, path)
    assert says in str(caught.value)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium to render")
def test_a_browser_renders_the_drawing(tmp_path: Path) -> None:
    picture = tmp_path / "wiring.png"
    subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
         f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}",
         "--window-size=1160,440", (tables.PAGE.parent / "wiring-max17048.svg").as_uri()],
        check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    shown = imread(picture)
    assert shown.shape[:2] == (440, 1160)
    # Not blank: boxes, wires and text differ from row to row.
    assert len({row.tobytes() for row in shown}) > 100
