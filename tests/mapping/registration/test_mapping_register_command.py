"""`blimp map register` from a shell: what it prints, keeps and refuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from hand_made import run

from ground_station.errors import MapError
from ground_station.geometry.trajectory import Trajectory
from ground_station.map import store
from ground_station.mapping.registration import command

ROOT = Path(__file__).parents[3]


def test_the_uncertainty_is_printed_and_kept(built, target, tmp_path, capsys):
    path = tmp_path / "truth.txt"
    rng = np.random.default_rng(0)
    truth = built.scene.wTc.copy()
    truth[:, :3, 3] += 0.02 * rng.normal(size=(len(truth), 3))
    poses = Trajectory.from_poses(built.map.keyframes.time_ns, truth)
    path.write_text(
        "\n".join(
            " ".join(f"{x:.9f}" for x in (t / 1e9, *p, *q))
            for t, p, q in zip(poses.time_ns, poses.position_m, poses.quaternion_xyzw, strict=True)
        )
    )
    assert run(command, target, "--trajectory", path, "--json", tmp_path / "r.json") == 0
    printed = capsys.readouterr().out
    assert "expected error at the middle of the map: " in printed and "cm in 90 %" in printed
    assert "its worst corner" in printed and "scale_sigma_percent" in printed
    kept, told = store.load_info(target).registration, json.loads((tmp_path / "r.json").read_text())
    for name in ("centre_90_percent_m", "corner_sigma_m", "scale_sigma_percent", "covariance"):
        assert kept[name] == told[name]
    assert 0.002 < kept["centre_sigma_m"] < 0.05


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "one of --page, --picks, --pairs, --tags, --trajectory, --distances is needed"),
        (["--tags", "t"], "--tags needs --frames"),
        (["--pairs", "p", "--frames", "f"], "--frames goes with --tags"),
        (["--pairs", "p", "--plan", "f"], "--plan goes with --page"),
        (["--picks", "p", "--plan-resolution-m", "1"], "--plan-resolution-m goes with --page"),
        (["--page", "--port", "70000"], "--port is 70000; allowed: 0 to 65535"),
        (["--page"], "there is no floorplan.yaml in it; give a plan with --plan"),
        (["--pairs", "p", "--seed", "-1"], "--seed is -1; allowed: 0 or more"),
        (["--picks", "{map}/map.toml"], "map.toml: the table 'plan' is missing"),
        (["--distances", "{map}/none.csv"], "none.csv: No such file"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(target, words, says):
    with pytest.raises(MapError, match=says.replace("(", r"\(")) as caught:
        run(command, target, *(word.format(map=target) for word in words))
    assert "\n" not in str(caught.value)
    assert not store.load_info(target).registered


def test_the_page_says_where_it_is_and_ends_with_ctrl_c(target, tmp_path):
    cv2.imwrite(str(tmp_path / "plan.png"), np.full((60, 80), 254, np.uint8))
    words = ["map", "register", target, "--page", "--no-browser", "--plan", tmp_path / "plan.png"]
    script = "import sys; from ground_station.cli import main; sys.exit(main(sys.argv[1:]))"
    with subprocess.Popen(
        [sys.executable, "-c", script, *map(str, words), "--plan-resolution-m", "0.1"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    ) as page:  # fmt: skip
        guard = threading.Timer(60, page.kill)
        guard.start()
        try:
            address = page.stdout.readline().removeprefix("the page: ").strip()
            assert address.startswith("http://127.0.0.1:") and len(address.split("/")[3]) >= 32
            with urllib.request.urlopen(address + "state", timeout=30) as answer:
                state = json.loads(answer.read())
            assert state["plan"]["resolution_m"] == 0.1 and state["picks"] == []
            page.send_signal(signal.SIGINT)
            printed, complained = page.communicate(timeout=30)
        finally:
            guard.cancel()
            page.kill()
    assert page.returncode == 0 and "nothing was saved" in printed and complained == ""
    assert not store.load_info(target).registered
