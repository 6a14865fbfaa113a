"""What befalls a radio's network costs seconds: video, poses and telemetry come back by themselves.

All cases are flown one after another, by `roaming_hosts.py`, in network namespaces of its own. They
have bounds in seconds, and fly in `make faults`: `make test` does not collect this by its name.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from namespaces import unshared

HOSTS = Path(__file__).with_name("roaming_hosts.py")
CASES = {
    "restarts": "the access point restarts, and the hosts have forgotten each other",
    "deauthenticated": "deauthentication in bursts",
    "payload_twin": "another station takes the payload's address",
    "ground_twin": "another station takes the ground station's address",
    "address_changes": "the payload gets another address",
    "narrow": "packets of more than 1,280 bytes vanish",
    "wide": "they do no longer",
    "no_multicast": "multicast is filtered, and the card names the ground station",
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Each case's `Result`."""
    command = [*unshared("ip link add c0 type bridge"), sys.executable, str(HOSTS)]
    run = subprocess.run(
        [*command, str(tmp_path_factory.mktemp("roaming"))],
        capture_output=True, text=True, timeout=1500,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return dict(json.loads(run.stdout))


@pytest.mark.parametrize("case", CASES, ids=CASES.values())
def test_all_is_back_by_itself(case: str, flown: dict[str, dict[str, Any]]) -> None:
    assert flown["start"]["back_s"] is not None, flown["start"]
    result = flown[case]
    assert result["lacking"] == "", "nothing befell"
    assert result["back_s"] is not None, result


def test_a_flight_goes_on_in_the_same_process_whatever_befalls_its_network(
    flown: dict[str, dict[str, Any]],
) -> None:
    """Two cases start the firmware themselves: it is what they are about."""
    assert [flown[case]["starts"] for case in CASES] == [1, 1, 1, 1, 1, 2, 2, 4]
