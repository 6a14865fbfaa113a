"""SRTP as GStreamer's encoder makes it is taken apart byte by byte, and nothing else is taken."""

import random
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from srtp_sender import SrtpSender

from ground_station.keys.authority import Authority
from ground_station.stream import rtp as rtp_stream
from ground_station.stream import srtp
from ground_station.stream.counters import Counters
from ground_station.stream.srtp import Unprotector
from pi_firmware.wire import srtcp
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.srtp import TAG_BYTES

KEY, OTHER_KEY = bytes(range(30)), bytes(range(30, 60))
ID = "blimp-1"


def rtp(index: int, ssrc: int = 77, size: int = 100) -> bytes:
    """An RTP packet of this 48-bit index, of which it carries 16 bits."""
    body = random.Random(index).randbytes(size)
    return struct.pack(">BBHII", 0x80, 96, index & 0xFFFF, 3000 * index & 0xFFFFFFFF, ssrc) + body


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def sender() -> Iterator[SrtpSender]:
    with SrtpSender(KEY) as made:
        yield made


@pytest.fixture
def small_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds of the search that a flood reaches with few packets."""
    monkeypatch.setattr(srtp, "SEARCH_RATE_HZ", 1000)
    monkeypatch.setattr(srtp, "SEARCH_TAGS", 64)


def roll(sender: SrtpSender, rollovers: int, ssrc: int = 77) -> None:
    """Takes a sender's stream to the end of its round number `rollovers`, in three steps each."""
    sender.protect(rtp(step * 0x5555, ssrc) for step in range(3 * rollovers + 1))


def junk(count: int, ssrc: int | None = None) -> Iterator[bytes]:
    rng = random.Random(8)
    for number in range(count):
        yield rtp(number, ssrc or rng.getrandbits(32)) + rng.randbytes(TAG_BYTES)


def test_session_keys_are_the_standards() -> None:
    # RFC 3711, B.3
    master = bytes.fromhex("E1F97A0D3E018BE0D64FA32C06DE41390EC675AD498AFEEBB6960B3AABE6")
    assert srtcp.derive(master, 0, 16) == bytes.fromhex("C61E7A93744F39EE10734AFE3FF7A087")
    assert srtcp.derive(master, 2, 14) == bytes.fromhex("30CBBC08863D8C85D49DB34A9AE1")
    assert srtcp.derive(master, 1, 94) == bytes.fromhex(
        "CEBE321F6FF7716B6FD4AB49AF256A156D38BAA48F0A0ACF3C34E2359E6CDBCE"
        "E049646C43D9327AD175578EF72270986371C10C9A369AC2F94A8C5FBCDDDC25"
        "6D6E919A48B610EF17C2041E474035766B68642C59BBFC2F34DB60DBDFB2"
    )


def test_the_keystream_is_the_standards() -> None:
    # RFC 3711, B.2
    key = bytes.fromhex("2B7E151628AED2A6ABF7158809CF4F3C")
    counter = int("F0F1F2F3F4F5F6F7F8F9FAFBFCFD0000", 16)
    stream = srtcp.aes_cm(key, counter, bytes(16 * 0xFF02))
    assert stream[:48] == bytes.fromhex(
        "E03EAD0935C95E80E166B16DD92B4EB4D23513162B02D0F72A43A2FE4A5F97AB"
        "41E95B3BB0A2E8DD477901E4FCA894C0"
    )
    assert stream[-48:] == bytes.fromhex(
        "EC8CDF7398607CB0F2D21675EA9EA1E4362B7C3C6773516318A077D7FC5073AE"
        "6A2CC3787889374FBEB4C81B17BA6C44"
    )


@pytest.mark.parametrize("first", [0, 1, 32_767, 32_768, 65_500, 65_535])
def test_what_was_protected_comes_out_byte_by_byte(sender: SrtpSender, first: int) -> None:
    plain = [rtp(first + number, size=7 * number) for number in range(200)]
    protected = sender.protect(plain)
    assert all(len(p) == len(q) + TAG_BYTES for p, q in zip(protected, plain, strict=True))
    assert not any(q[12:] in p for p, q in zip(protected[5:], plain[5:], strict=True))
    unprotector = Unprotector({"blimp-0": OTHER_KEY, ID: KEY})
    assert [unprotector.unprotect(packet) for packet in protected] == plain
    assert unprotector.sender == ID
    assert unprotector.counters.refused == unprotector.counters.replayed == 0


def test_headers_with_sources_extension_and_padding_come_out_too(sender: SrtpSender) -> None:
    extension = b"\xbe\xde\x00\x01\x10\xff\x00\x00"
    sources = struct.pack(">II", 1, 2)
    plain = []
    for number, (flags, more) in enumerate(
        [(0x02, sources), (0x10, extension), (0x12, sources + extension), (0x20, b"")]
    ):
        head = struct.pack(">BBHII", 0x80 | flags, 96, number, 0, 77)
        plain.append(head + more + b"\x65payload" + (b"\x00\x00\x03" if flags & 0x20 else b""))
    unprotector = Unprotector({ID: KEY})
    assert [unprotector.unprotect(packet) for packet in sender.protect(plain)] == plain


@pytest.mark.parametrize("rollovers", [1, 2, 40, 1000])
def test_a_receiver_that_joins_after_rollovers_finds_their_number(
    sender: SrtpSender, rollovers: int
) -> None:
    roll(sender, rollovers)
    plain = [rtp(rollovers * 0x10000 + number) for number in range(1, 50)]
    unprotector = Unprotector({"blimp-0": OTHER_KEY, ID: KEY})
    assert [unprotector.unprotect(packet) for packet in sender.protect(plain)] == plain
    searched = unprotector.tags_searched
    assert searched == 2 * rollovers + 2  # for the first packet, and never again


def test_a_stream_of_any_age_is_joined_by_and_by(
    sender: SrtpSender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(srtp, "SEARCH_TAGS", 8)
    roll(sender, 21)
    plain = [rtp(21 * 0x10000 + number) for number in range(1, 10)]
    unprotector = Unprotector({ID: KEY})
    taken = [unprotector.unprotect(packet) for packet in sender.protect(plain)]
    # Each packet is tried with four counters from 0 on and four more: 4, 8, 12, 16, 20.
    assert taken == [None] * 4 + plain[4:]
    # And whatever came before: from the oldest on, it goes round.
    monkeypatch.setattr(srtp, "_ROC_LIMIT", 24)
    for hostile in range(12):
        unprotector = Unprotector({ID: KEY})
        assert not any(map(unprotector.unprotect, junk(hostile)))
        later = [rtp(21 * 0x10000 + 20 * (hostile + 1) + number) for number in range(5)]
        taken = [unprotector.unprotect(packet) for packet in sender.protect(later)]
        assert taken[-1] == later[-1]


def test_reordered_packets_are_taken_across_the_wrap(sender: SrtpSender) -> None:
    plain = [rtp(0xFFFF - 500 + number) for number in range(1000)]
    protected = sender.protect(plain)
    rng = random.Random(3)
    order = sorted(range(1000), key=lambda number: number + rng.uniform(0, 200))
    unprotector = Unprotector({ID: KEY})
    assert [unprotector.unprotect(protected[n]) for n in order] == [plain[n] for n in order]


def test_the_first_packet_may_be_one_from_behind_the_wrap(sender: SrtpSender) -> None:
    plain = [rtp(index) for index in (0xFFFE, 0xFFFF, 0x10000)]
    protected = sender.protect(plain)
    unprotector = Unprotector({ID: KEY})
    for number in (2, 0, 1):
        assert unprotector.unprotect(protected[number]) == plain[number]


def test_a_packet_is_taken_once(sender: SrtpSender) -> None:
    protected = sender.protect(rtp(0xFFFF - 50 + number) for number in range(100))
    unprotector = Unprotector({ID: KEY})
    assert None not in [unprotector.unprotect(packet) for packet in protected]
    assert [unprotector.unprotect(packet) for packet in protected] == [None] * 100
    assert unprotector.counters.replayed == 100 and unprotector.counters.refused == 0


def test_a_packet_too_old_to_tell_is_not_taken(sender: SrtpSender) -> None:
    last = srtp.REPLAY_WINDOW
    first, second, newest = sender.protect([rtp(0), rtp(1), rtp(last)])
    unprotector = Unprotector({ID: KEY})
    assert unprotector.unprotect(newest) is not None
    assert unprotector.unprotect(first) is None  # never came, but may have
    assert unprotector.unprotect(second) is not None
    assert unprotector.counters.replayed == 1


@pytest.mark.parametrize(
    ("first", "gone"),
    [(0, 40_000), (60_000, 30_000), (60_000, 33_000), (60_000, 0x10000 - 20), (60_000, 10**6)],
)
def test_a_stream_is_taken_again_after_a_long_silence(
    sender: SrtpSender, first: int, gone: int
) -> None:
    before = [rtp(first + number) for number in range(100)]
    protected = sender.protect(before)
    again = first + 100 + gone
    sender.protect(rtp(index) for index in range(first + 100, again, 10_000))
    after = [rtp(again + number) for number in range(100)]
    unprotector = Unprotector({ID: KEY})
    assert [unprotector.unprotect(packet) for packet in protected] == before
    assert [unprotector.unprotect(packet) for packet in sender.protect(after)] == after


@pytest.mark.usefixtures("small_search")
def test_nothing_tampered_with_is_taken(sender: SrtpSender) -> None:
    genuine = sender.protect([rtp(0), rtp(1)])
    for joined in (False, True):
        unprotector = Unprotector({ID: KEY}, clock=lambda: 0.0)
        if joined:
            assert unprotector.unprotect(genuine[0]) is not None
        for bit in range(8 * len(genuine[1])):
            tampered = bytearray(genuine[1])
            tampered[bit // 8] ^= 1 << bit % 8
            assert unprotector.unprotect(bytes(tampered)) is None, bit
        for size in range(len(genuine[1])):
            assert unprotector.unprotect(genuine[1][:size]) is None, size
        assert unprotector.unprotect(genuine[1] + b"\x00") is None
        assert unprotector.counters.refused == 9 * len(genuine[1]) + 1
        assert unprotector.counters.replayed == 0


@pytest.mark.usefixtures("small_search")
def test_other_keys_and_plain_packets_are_refused(sender: SrtpSender) -> None:
    plain = [rtp(number) for number in range(20)]
    unprotector = Unprotector({ID: OTHER_KEY, "blimp-2": OTHER_KEY[::-1]})
    assert not any(map(unprotector.unprotect, [*sender.protect(plain), *plain]))
    nobody = Unprotector({})
    assert not any(map(nobody.unprotect, [*sender.protect([rtp(20)]), *plain]))
    assert unprotector.counters.refused == 40 and nobody.counters.refused == 21


def test_what_cannot_be_the_videos_is_refused_without_a_search(sender: SrtpSender) -> None:
    genuine = sender.protect([rtp(0)])[0]
    other_type, other_version = bytearray(genuine), bytearray(genuine)
    other_type[1] ^= 4  # 97 and 98 come beside the video
    other_version[0] ^= 0x40
    endless = bytes([genuine[0] | 0x10]) + genuine[1:14] + b"\xff\xff" + genuine[16:]
    unprotector = Unprotector({ID: KEY})
    for packet in (bytes(other_type), bytes(other_version), endless, genuine[:21], b""):
        assert unprotector.unprotect(packet) is None
    assert unprotector.counters.refused == 5 and unprotector.tags_searched == 0


@pytest.mark.usefixtures("small_search")
def test_a_flood_of_streams_is_searched_within_bounds_and_kept_out(sender: SrtpSender) -> None:
    clock = Clock()
    unprotector = Unprotector({ID: KEY, "blimp-2": OTHER_KEY}, clock=clock)
    plain = [rtp(number) for number in range(800)]
    protected = sender.protect(plain)
    for number, hostile in enumerate(junk(800)):
        assert unprotector.unprotect(hostile) is None
        assert number % 2 or unprotector.unprotect(protected[number]) == plain[number]
    assert unprotector.tags_searched <= srtp.SEARCH_RATE_HZ + srtp.SEARCH_TAGS
    for seconds in (1.0, 1.0, 1.0, 1000.0, 1.0):
        clock.now_s += seconds
        before = unprotector.tags_searched
        for hostile in junk(200):
            unprotector.unprotect(hostile)
        assert unprotector.tags_searched - before <= srtp.SEARCH_RATE_HZ + srtp.SEARCH_TAGS
    assert sum(map(len, unprotector._streams.values())) == 1
    # A new stream is found as soon as there is something left to search with.
    late = sender.protect([rtp(number, ssrc=78) for number in range(2)])
    assert unprotector.unprotect(late[0]) is None
    clock.now_s += 1.0
    assert unprotector.unprotect(late[1]) == rtp(1, ssrc=78)


@pytest.mark.usefixtures("small_search")
def test_a_flood_in_a_known_streams_name_does_not_stop_it(sender: SrtpSender) -> None:
    clock = Clock()
    unprotector = Unprotector({ID: KEY}, clock=clock)
    plain = [rtp(60_000 + number) for number in range(400)]
    protected = sender.protect(plain)
    for hostile, packet, own in zip(junk(400, ssrc=77), protected, plain, strict=True):
        assert unprotector.unprotect(hostile) is None
        assert unprotector.unprotect(packet) == own
    assert unprotector.tags_searched <= 2 * (srtp.SEARCH_RATE_HZ + srtp.SEARCH_TAGS)
    assert unprotector.counters.refused == 400


def test_streams_are_bounded_and_those_heard_lately_are_kept(sender: SrtpSender) -> None:
    unprotector = Unprotector({ID: KEY})
    for number in range(3 * srtp.STREAMS):
        own, other = sender.protect([rtp(number, ssrc=1), rtp(number, ssrc=1000 + number)])
        assert unprotector.unprotect(own) is not None
        assert unprotector.unprotect(other) is not None
    assert len(unprotector._streams[ID]) == srtp.STREAMS
    assert 1 in unprotector._streams[ID] and 1000 not in unprotector._streams[ID]


def test_a_payload_with_many_ssrcs_takes_no_place_of_anothers_stream(sender: SrtpSender) -> None:
    unprotector = Unprotector({ID: KEY, "blimp-2": OTHER_KEY})
    (packet,) = sender.protect([rtp(0, ssrc=1)])
    assert unprotector.unprotect(packet) is not None
    with SrtpSender(OTHER_KEY) as other:
        for protected in other.protect(rtp(0, ssrc=100 + number) for number in range(70)):
            assert unprotector.unprotect(protected) is not None
    assert unprotector.unprotect(packet) is None and unprotector.counters.replayed == 1


@pytest.mark.usefixtures("small_search")
def test_an_earlier_part_played_back_does_not_keep_the_live_stream_away(
    sender: SrtpSender,
) -> None:
    early = sender.protect(rtp(number) for number in range(100))
    sender.protect(rtp(index) for index in range(0x4000, 3 * 0x10000, 0x4000))
    plain = [rtp(3 * 0x10000 + number) for number in range(1, 101)]
    live = sender.protect(plain)
    unprotector = Unprotector({ID: KEY})
    assert unprotector.unprotect(early[0]) is not None  # authentic, and nothing newer is known
    for replayed, packet, own in zip(early[1:], live[1:], plain[1:], strict=True):
        assert unprotector.unprotect(packet) == own
        assert unprotector.unprotect(replayed) is None


def test_one_ssrc_in_two_payloads_hands_is_two_streams(sender: SrtpSender) -> None:
    plain = [rtp(0xFFFE + number) for number in range(4)]
    with SrtpSender(OTHER_KEY) as other:
        squatting = other.protect(plain)
    unprotector = Unprotector({"blimp-0": OTHER_KEY, ID: KEY})
    for packet, theirs, own in zip(plain, squatting, sender.protect(plain), strict=True):
        assert unprotector.unprotect(theirs) == packet and unprotector.sender == "blimp-0"
        assert unprotector.unprotect(own) == packet and unprotector.sender == ID
        assert unprotector.unprotect(own) is None


def test_what_the_reorderer_takes_for_a_new_sender_is_too_old(sender: SrtpSender) -> None:
    played_back = sender.protect(rtp(number) for number in range(20))
    live = sender.protect(rtp(rtp_stream.MAX_JUMP + number) for number in range(1, 50))
    unprotector, reorderer = Unprotector({ID: KEY}), rtp_stream.Reorderer(Counters())
    given = []
    for datagram in [*live[:2], *played_back, *live[2:]]:
        if (plain := unprotector.unprotect(datagram)) is not None:
            packet = rtp_stream.parse(plain, 0)
            assert packet is not None
            given += [taken.sequence for taken, _ in reorderer.push(packet)]
    assert given == [rtp_stream.MAX_JUMP + number for number in range(1, 50)]


def test_a_counter_at_its_end_does_not_end_the_receiver(sender: SrtpSender) -> None:
    packet = sender.protect([rtp(0)])[0]
    unprotector = Unprotector({ID: KEY})
    assert unprotector.unprotect(packet) is not None
    unprotector._streams[ID][77].highest = (1 << 48) - 1
    assert unprotector.unprotect(packet) is None


def test_keys_are_read_as_the_authority_wrote_them(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys")
    ground = authority.add("ground", "main")
    for payload_id in ("blimp-1", "blimp-2"):
        authority.add("payload", payload_id)
    keys = srtp.load_keys(ground)
    assert sorted(keys) == ["blimp-1", "blimp-2"]
    for payload_id, key in keys.items():
        own = authority.of(f"payload.{payload_id}") / "srtp.key"
        assert key == bytes.fromhex(own.read_text()) and len(key) == 30
    authority.revoke("payload.blimp-1")
    (ground / "srtp" / "blimp-3.key.part").write_text("cut")
    assert sorted(srtp.load_keys(str(ground))) == ["blimp-2"]


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("blimp-1.key", b"abcd\n", r"2 bytes; an SRTP key with its salt has 30 \(60 digits\)"),
        ("blimp-1.key", b"", r"0 bytes; an SRTP key"),
        ("blimp-1.key", b"xy" * 30, r"not hexadecimal digits"),
        ("blimp-1.key", b"\xff\xfe" * 30, r"not hexadecimal digits"),
        ("blimp-1.key", b"00" * 5000, r"2048 bytes"),
        ("Blimp 1.key", b"00" * 30, r"not the name of a payload"),
    ],
)
def test_a_wrong_key_file_is_one_line(
    tmp_path: Path, name: str, content: bytes, reason: str
) -> None:
    (tmp_path / "srtp").mkdir()
    (tmp_path / "srtp" / name).write_bytes(content)
    with pytest.raises(StreamError, match=reason) as caught:
        srtp.load_keys(tmp_path)
    assert "\n" not in str(caught.value) and name in str(caught.value)


def test_what_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(StreamError, match=r"srtp: No such file or directory$"):
        srtp.load_keys(tmp_path)
    (tmp_path / "srtp" / "blimp-1.key").mkdir(parents=True)
    with pytest.raises(StreamError, match=r"blimp-1\.key: Is a directory$"):
        srtp.load_keys(tmp_path)
    with pytest.raises(StreamError, match=r"'blimp-1': 16 bytes; it has 30$"):
        Unprotector({ID: bytes(16)})
