"""`make hil`'s program: a case end to end, a missed bound, bad input, a recording that is cut."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import suite
from links.namespace import netem
from links.proxy import ProxyLink
from payloads import small

from ground_station.recording.flight import camera_of
from ground_station.replay.cases.case import Link, load_case
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingReader

CASES = Path(__file__).with_name("cases")
SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def hil(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """Runs the program, in this process."""

    def run(*words: object) -> Done:
        with monkeypatch.context() as patch:
            patch.setattr(suite.signal, "signal", lambda *_: None)  # the test runner's own stay
            return Done(suite.main([str(word) for word in words]), *capsys.readouterr())

    return run


def write(folder: Path, name: str, bounds: str, more: str = "", recording: object = "") -> Path:
    """A case of two seconds at 5 Hz, stepped, so that a busy machine drops no frame."""
    path = folder / f"{name}.toml"
    path.write_text(
        f'title = "{name}"\nrecording = "{recording or SAMPLE / "flight.mcap"}"\n'
        f'map = "{SAMPLE}"\nrate_hz = 5.0\nstart_s = 2.0\nduration_s = 2.0\n'
        f'stepped = true\n{more}\n[truth]\nkind = "recording"\n[bounds]\n{bounds}\n'
    )
    return path


def test_cases_are_flown_judged_and_shown(tmp_path: Path, hil: Callable[..., Done]) -> None:
    """One that holds, over a link that does something; one that misses a bound: status 1.

    That one's recording is cut: it is flown to its last whole chunk and said to be cut.
    """
    out = tmp_path / "out"
    link = '[link]\nkind = "proxy"\nseed = 9\nduplicate = 0.1\n'
    good = write(tmp_path, "good", "position_max_m = 0.5\nlost_max = 0.0", link)
    cut = tmp_path / "cut.mcap"
    whole = (SAMPLE / "flight.mcap").read_bytes()
    cut.write_bytes(whole[: len(whole) // 8])
    bounds = "position_max_m = 1e-6\nlost_max = 0.0"
    missed = write(tmp_path, "missed", bounds, recording=cut)
    done = hil(good, missed, "--out", out)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "MISSED position_max_m" in done.stdout and "cut.mcap was cut (" in done.stdout
    assert "injected: proxy, seed 9: duplicate=0.1" in done.stdout
    told = json.loads((out / "suite.json").read_text())
    assert [case["passed"] for case in told["cases"]] == [True, False], done.stdout
    assert not told["passed"]
    run = told["cases"][0]["outcome"]
    counts, accounts = run["link_counts"], run["accounts"]
    assert accounts["captured"] == 10
    assert counts["received"] == counts["passed"] and counts["lost"] == 0 < counts["duplicated"]
    # The last packet's copy may come when all is counted.
    copies = run["stream"]["packets"] - counts["passed"]
    assert counts["duplicated"] - 1 <= copies <= counts["duplicated"]
    captured = told["cases"][1]["outcome"]["accounts"]["captured"]
    times = [sample.time_ns for sample in RecordingReader(cut).video()]
    assert 0 < captured <= (times[-1] - times[0]) / 1e9 * 5 - 2 * 5 + 1 < 10
    root = ElementTree.parse(out / "junit.xml").getroot()
    assert root.get("failures") == "1" and root.get("errors") == "0"
    failed = [test for test in root.iter("testcase") if test.find("failure") is not None]
    assert [(test.get("classname"), test.get("name")) for test in failed] == [
        ("hil.process.missed", "position_max_m")
    ]
    assert "good" in (out / "index.html").read_text()
    for name in ("result.json", "frames.csv", "estimate.txt", "firmware.log"):
        assert (out / "good" / name).is_file()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["no-such"], "'no-such': no such case"),
        (["--payload", "telnet"], "--payload is 'telnet'; allowed: process, image, ssh:"),
        (["--payload", "ssh:-x"], "expected ssh:user@host"),
        (["--payload", "image", "--image", "/none.img"], "/none.img: not there; `make image"),
        (["--against", "out/same", "--out", "out/same"], "is --out, too"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    words: list[str], told: str, hil: Callable[..., Done]
) -> None:
    done = hil(*words)
    assert done.returncode == 2 and told in done.stderr
    assert done.stderr.startswith("hil: ") and done.stderr.count("\n") == 1


def test_a_bad_case_is_refused_before_any_is_flown(
    tmp_path: Path, hil: Callable[..., Done]
) -> None:
    good = write(tmp_path, "good", "lost_max = 0.0")
    bad = write(tmp_path, "bad", "lost_max = 1.5")
    done = hil(good, bad, "--out", tmp_path / "out")
    assert done.returncode == 2 and done.stdout == ""
    assert "bounds.lost_max" in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_shipped_cases_load_and_fly_on_several_payloads() -> None:
    cases = [load_case(path) for path in sorted(CASES.glob("*.toml"))]
    assert 8 <= len(cases) <= 16
    assert {case.link.kind for case in cases} == {"loopback", "proxy", "namespace"}
    for kind in ("image", "ssh"):
        assert sum(kind in case.payload.kinds for case in cases) >= 8
    for case in cases:
        if "image" in case.payload.kinds:
            assert case.flown("image").rate_hz == 5.0
            assert case.limits("image").coverage_min is None


def test_a_small_recording_is_the_same_flight_through_a_coarser_grid(tmp_path: Path) -> None:
    size = small.Size(320, 240, 5.0)
    source = tmp_path / "part.mcap"
    whole = (SAMPLE / "flight.mcap").read_bytes()
    source.write_bytes(whole[: len(whole) // 10])
    made = small.small(source, tmp_path / "cache", size)
    written = made.stat().st_mtime_ns
    assert small.small(source, tmp_path / "cache", size) == made  # once
    assert made.stat().st_mtime_ns == written
    reader, before = RecordingReader(made), RecordingReader(source)
    camera, original = camera_of(reader), camera_of(before)
    assert camera is not None and original is not None
    assert (camera.width_px, camera.height_px) == (320, 240)
    ray = np.array([[0.2, -0.1, 1.0]])
    np.testing.assert_allclose(
        (camera.project(ray) + 0.5) * 2 - 0.5, original.project(ray), atol=1e-9
    )
    times = [sample.time_ns for sample in reader.video()]
    taken = {sample.time_ns for sample in before.video()}
    assert len(times) > 5 and set(times) <= taken
    assert np.diff(times) / 1e9 == pytest.approx(0.2, abs=0.02)
    assert {pose.time_ns for pose in reader.poses(TRUTH_TOPIC)} <= set(times)


def test_outages_are_told_by_the_wall_clock_once_they_have_begun() -> None:
    link = ProxyLink(Link(kind="proxy", outages=[[0.0, 0.25], [500.0, 1.0]]))
    assert link.outages() == []
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to,
        link(9) as port,
    ):
        begun_ns = time.time_ns()
        while not link.counts()["received"]:
            to.sendto(b"here", ("127.0.0.1", port))
            time.sleep(0.01)
        (outage,) = link.outages()
        assert begun_ns - 1e6 < outage.begin_ns < time.time_ns()
        assert outage.end_ns - outage.begin_ns == pytest.approx(0.25e9, abs=1000)
        assert link.counts()["passed"] == 0
    assert link.injected() == "proxy, seed 0: outages=[[0.0, 0.25], [500.0, 1.0]]"


def test_a_link_in_the_kernels_words() -> None:
    link = Link(kind="namespace", seed=3, loss=0.02, delay_s=0.1, jitter_s=0.02, duplicate=0.01)
    assert netem(link) == [
        "delay", "110ms", "10ms", "loss", "random", "2%", "duplicate", "1%", "seed", "3",
    ]  # fmt: skip
    assert netem(Link(kind="namespace", outages=[[1.0, 2.0]])) == []
    rate = netem(Link(kind="namespace", rate_kbps=800.0, queue_s=0.28))
    assert rate == ["rate", "800kbit", "limit", "20", "seed", "0"]
    assert "proxy" in netem(Link(kind="namespace", reorder=0.1))
