"""Invariant 1: each party's account of the frames, and one against the other. Pure functions.

All return what is wrong, in words; nothing where the account holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence

_INSIDE = 40
"""Frames that may be in the encoder when a payload is killed."""


def of_payload(counts: Mapping[str, int]) -> list[str]:
    """captured = gated + sent + discarded, of a payload that has ended in order."""
    if not counts:
        return ["the payload printed no counters"]
    said = {name: counts.get(name, 0) for name in ("captured", "gated", "sent", "discarded")}
    if said["captured"] == said["gated"] + said["sent"] + said["discarded"]:
        return []
    return [f"payload: captured is not gated + sent + discarded: {said}"]


def of_killed_payload(counts: Mapping[str, int]) -> list[str]:
    """The same by the last that it said before it was killed: a few are inside the encoder."""
    if "captured" not in counts:
        return []  # it was killed before it said anything
    inside = counts["captured"] - sum(counts.get(n, 0) for n in ("gated", "sent", "discarded"))
    if 0 <= inside <= _INSIDE:
        return []
    return [f"payload, before it was killed: {inside} frames of {dict(counts)} are nowhere"]


def of_link(sent: int, left: int, gaps: int) -> list[str]:
    """What the payload says it sent is what came to the link, unless packets were missing there."""
    if sent == left or (gaps > 0 and left <= sent):
        return []
    return [f"payload: it says it sent {sent} frames, {left} came to the link"]


def of_intake(frames: Mapping[str, int], sent: int, before: tuple[int, int] = (0, 0)) -> list[str]:
    """sent = received + withheld + lost, of the payload's last stream, by its final counters.

    An intake that began while the stream came does not count what was `before`: so many frames at
    least, and at most.
    """
    if frames.get("sent") != sent:
        return [f"intake: it was told of {frames.get('sent')} frames sent, there were {sent}"]
    arrived = {name: frames.get(name, 0) for name in ("received", "withheld", "lost")}
    least, most = before
    if least <= sent - sum(arrived.values()) <= most:
        return []
    earlier = f", {least} to {most} before it began" if most else ""
    return [f"intake: sent is not received + withheld + lost: {sent}, {arrived}{earlier}"]


def of_shown(
    shown: Sequence[int], damaged: Sequence[int], showable: Sequence[int], who: str
) -> list[str]:
    """Sequence numbers of one stream: each frame that was shown came once, and whole where it was
    not told as damaged."""
    twice = [number for number, times in Counter(shown).items() if times > 1]
    wrong = sorted(set(shown) - set(damaged) - set(showable))
    return [
        *([f"{who}: shown more than once: {twice[:10]}"] if twice else []),
        *([f"{who}: shown, but damaged or never sent: {wrong[:10]}"] if wrong else []),
    ]


def of_received(heard: int, received: int, dropped: int) -> list[str]:
    """Frames that were shown are those that the intake says it received, less dropped ones."""
    if heard == received - dropped:
        return []
    return [f"intake: {received} received, {dropped} dropped, {heard} shown"]


def of_localizer(taken: Sequence[tuple[int, int]]) -> list[str]:
    """processed + skipped is every frame of a session since the first that was told of.

    `taken` has, for each estimate, its frame's place among all frames that were shown and the sum
    processed + skipped that was told with it. A frame that is neither moves all later sums by one:
    some number of frames before the first must explain all of them.
    """
    low, high = -(1 << 62), 1 << 62
    for index, (place, told) in enumerate(taken):
        if index and place <= taken[index - 1][0]:
            return [f"localizer: frame {place} after frame {taken[index - 1][0]}"]
        # All up to this frame are counted by now, and none from the next one on that was taken.
        low = max(low, place + 1 - told)
        if index + 1 < len(taken):
            high = min(high, taken[index + 1][0] - told)
        if low > high:
            return [
                f"localizer: at frame {place} it has told of {told} processed or skipped;"
                f" {low - high} frames are neither"
            ]
    return []


def by_process(counts: Sequence[tuple[Hashable, int, int]]) -> list[list[tuple[int, int]]]:
    """(service's run, place, told) by session: a new one counts from the beginning."""
    result: list[list[tuple[int, int]]] = []
    before: tuple[Hashable, int] | None = None
    for run, place, told in counts:
        if before is None or run != before[0] or told <= before[1]:
            result.append([])
        result[-1].append((place, told))
        before = run, told
    return result
