"""What the flights of a long run of the service must add up to, exactly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from soaking.table import Row


@dataclass
class Flight:
    """One flight's account: the payload's own at its end, the intake's, the localizer's."""

    payload: dict[str, int]
    intake: dict[str, int]
    localizer: dict[str, int]
    in_order: bool


def account_rows(flights: Sequence[Flight]) -> list[Row]:
    """All flights together, exact for each: what was sent, what came, and what became of it."""
    payload: Counter[str] = Counter()
    intake: Counter[str] = Counter()
    own: Counter[str] = Counter()
    off_sent = off_received = not_taken = 0
    for number, flight in enumerate(flights):
        payload.update(flight.payload)
        intake.update(flight.intake)
        own.update(flight.localizer)
        came, told = flight.intake, flight.localizer
        arrived = came.get("received", 0) + came.get("withheld", 0) + came.get("lost", 0)
        off_sent += flight.payload.get("sent", -1) != arrived
        behind = came.get("received", 0) - told.get("processed", 0) - told.get("skipped", 0)
        if number == 0:
            not_taken = behind  # before its localizer was up
        off_received += behind != 0 and (number > 0 or behind < 0)
    encoded = payload["captured"] - payload["gated"]
    in_order = sum(flight.in_order for flight in flights)
    exact = f"exact in all {len(flights)}"
    return [
        Row(
            "flights, ended in order",
            f"{in_order} of {len(flights)}",
            "all",
            bool(flights) and in_order == len(flights),
        ),
        Row(
            "captured − gated = sent + discarded",
            f"{encoded} = {payload['sent']} + {payload['discarded']}",
            "exact",
            encoded == payload["sent"] + payload["discarded"],
        ),
        Row(
            "sent = received + withheld + lost",
            f"{payload['sent']} = {intake['received']} + {intake['withheld']} + {intake['lost']}",
            exact,
            off_sent == 0,
        ),
        Row(
            "received = processed + skipped",
            f"{intake['received']} = {own['processed']} + {own['skipped']} + {not_taken}",
            exact,
            off_received == 0,
        ),
        Row("  of these before the localizer", str(not_taken)),
        Row("localized, of those processed", f"{own['localized']} of {own['processed']}"),
    ]
