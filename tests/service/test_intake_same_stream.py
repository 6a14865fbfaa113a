"""A payload whose SSRC is configured starts anew: its new session has an account of its own."""

from __future__ import annotations

from pathlib import Path

from intake_stand import Stand, eventually


def test_a_session_with_the_ssrc_of_the_one_before_counts_from_its_own_beginning(
    tmp_path: Path,
) -> None:
    fixed = ("link.ssrc=77", "camera.rate_hz=10")
    with Stand(tmp_path) as stand:
        for _ in range(2):
            before = len(stand.heard.of("blimp-1"))
            payload = stand.payload("blimp-1", *fixed)
            eventually(lambda before=before: len(stand.heard.of("blimp-1")) > before + 20)
            ended = payload.end()
            ended.assert_in_order()
            account = stand.settled("blimp-1", ended.counts).frames
            shown = len(stand.heard.of("blimp-1")) - before
            assert account["received"] == shown
            assert account["sent"] == shown + account["withheld"] + account["lost"]
        assert {note.ssrc for note, _ in stand.heard.of("blimp-1")} == {77}
