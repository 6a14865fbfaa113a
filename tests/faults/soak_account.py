"""What a long flight must add up to: every frame accounted for, end to end, one by one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from soaking.table import Row
from witness import Witness

from ground_station.stream.assembly import ReceivedFrame


@dataclass
class Account:
    """What each party says of the frames and packets of a flight that has ended."""

    seen: list[int] = field(default_factory=list)
    """Numbers of the frames that the receiver gave, in order."""
    damaged: set[int] = field(default_factory=set)
    """Those of them that were not whole."""
    counts: dict[str, int] = field(default_factory=dict)
    """The payload's own."""
    status: int = -1
    err: str = ""
    witness: Witness = field(default_factory=Witness)
    link: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)

    def take(self, frame: ReceivedFrame) -> None:
        """One more that the receiver gave."""
        self.seen.append(frame.sequence)
        if frame.damaged is not None:
            self.damaged.add(frame.sequence)


def account_rows(account: Account) -> list[Row]:
    """The frames: each party's numbers against the others'."""
    counts, link, received = account.counts, account.link, account.received
    ended = account.status == 0 and not account.err
    rows = [Row("exit status", str(account.status), "0", ended)]
    if not counts:
        return [*rows, Row("frames", "the payload printed no counters", "", False)]
    witness = account.witness
    encoded = counts["captured"] - counts["gated"]
    left, visible = [frame.sequence for frame in witness.left()], witness.visible()
    whole = [sequence for sequence in account.seen if sequence not in account.damaged]
    showable = witness.showable()
    lost = counts["sent"] - len(account.seen)
    given_up = received["packets_late"] - link["duplicated"]
    odd = {
        "not shown": sorted({*visible} - {*whole}),
        "shown, but cut": sorted({*whole} - {*showable}),
        "twice or late": [b for a, b in itertools.pairwise(account.seen) if b <= a],
    }
    return [
        *rows,
        Row("captured", str(counts["captured"]), "", counts["captured"] > 0),
        Row("gated", str(counts["gated"])),
        Row(
            "encoded, sent + discarded",
            f"{encoded} = {counts['sent']} + {counts['discarded']}",
            "exact",
            encoded == counts["sent"] + counts["discarded"],
        ),
        Row(
            "sent, seen to leave",
            f"{counts['sent']} = {len(left)}",
            "exact",
            left == sorted(set(left)) and len(left) == counts["sent"] and witness.gaps == 0,
        ),
        Row("received", str(len(account.seen)), "", len(account.seen) > 0),
        Row(
            "shown whole, at least and at most",
            f"{len(visible)} <= {len(whole)} <= {len(showable)}{_named(odd)}",
            "exact, one by one",
            not any(odd.values()),
        ),
        Row(
            "shown damaged, lost, of damaged and following",
            f"{len(account.damaged)} + {lost} of {len(left) - len(visible)}",
            "one by one",
            account.damaged <= {*left},
        ),
        Row(
            "packets lost, on the link",
            f"{received['packets_lost']} = {link['lost']}",
            "exact",
            received["packets_lost"] - given_up == link["lost"]
            and received["packets"] == link["passed"] == link["received"] - link["lost"],
        ),
        Row("packets given up too early", str(given_up)),
    ]


def _named(odd: Mapping[str, Sequence[int]]) -> str:
    """The frames that something is wrong with, some of them."""
    return "".join(f"; {what}: {[*frames[:5]]}" for what, frames in odd.items() if frames)
