"""A build's cache gives back what was put in, survives damage, and knows what a setting touches."""

from __future__ import annotations

import dataclasses
import sqlite3
import threading

import numpy as np
import pytest

from ground_station.features import extractors
from ground_station.features.extractor import Features
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.mapping.construction import cache as caching
from ground_station.mapping.construction import content, entries
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.construction.entries import Entry, EntryError
from ground_station.mapping.construction.verification import key_of, rules_of
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.two_view import TwoView

FILE = "mapping-1.sqlite"
KEY = bytes(range(32))


def _key(n):
    return n.to_bytes(32, "big")


def _features(n=40, dimension=16, seed=0):
    rng = np.random.default_rng(seed)
    return Features(*(rng.random(s).astype(np.float32) for s in ((n, 2), n, (n, dimension))))


def _view(homography=True):
    rng = np.random.default_rng(1)
    matches = rng.integers(0, 40, (25, 2)).astype(np.int32)
    H = rng.random((3, 3)) if homography else None
    return TwoView(matches, rng.random((3, 3)), H, homography)


def _same(one, other):
    return all(
        np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype
        for a, b in zip(dataclasses.astuple(one), dataclasses.astuple(other), strict=True)
    )


def test_what_was_kept_is_found_bit_for_bit_by_another_build(tmp_path):
    none, many = _features(0), _features(700, 128)
    with Cache(tmp_path / "new" / "folder") as cache:
        assert cache.features(_key(1)) is None and cache.view(_key(3), (40, 40)) is None
        cache.keep_features(_key(1), many)
        cache.keep_features(_key(2), none)
        cache.keep_view(_key(3), _view())
        cache.keep_view(_key(4), _view(homography=False))
        cache.keep_view(_key(5), None)
        assert _same(cache.features(_key(1)), many)  # whether it is on disk yet or not
    with Cache(tmp_path / "new" / "folder") as cache:
        assert _same(cache.features(_key(1)), many)
        assert _same(cache.features(_key(2)), none)
        for key, view in ((_key(3), _view()), (_key(4), _view(homography=False))):
            assert _same(cache.view(key, (40, 40)).view, view)
        assert cache.view(_key(5), (40, 40)).view is None
        assert cache.view(_key(6), (40, 40)) is None
        assert dataclasses.asdict(cache.figures) == {
            "features_found": 2, "features_made": 0, "pairs_found": 3, "pairs_made": 0,
            "damaged": 0,
        }  # fmt: skip


@pytest.mark.parametrize(
    "damage",
    [
        "data = zeroblob(length(data))",
        "data = substr(data, 1, length(data) - 4)",
        "data = 'text'",
        "rows = 41",
        "rows = 1000000000",
        "columns = -1",
        "kind = 2",
        "digest = zeroblob(16)",
    ],
)
def test_a_damaged_entry_is_made_anew_and_it_is_said_once(tmp_path, capsys, damage):
    with Cache(tmp_path) as cache:
        for n in (1, 2):
            cache.keep_features(_key(n), _features(seed=n))
    with sqlite3.connect(tmp_path / FILE) as db:
        db.execute(f"UPDATE entries SET {damage}")
    db.close()
    with Cache(tmp_path) as cache:
        assert cache.features(_key(1)) is None and cache.features(_key(2)) is None
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and "is damaged" in lines[0] and FILE in lines[0]
        assert cache.figures.damaged == 2
        cache.keep_features(_key(1), _features(seed=1))
    with Cache(tmp_path) as cache:
        assert _same(cache.features(_key(1)), _features(seed=1))


def test_a_pair_that_names_features_which_are_not_there_is_compared_again(tmp_path, capsys):
    with Cache(tmp_path) as cache:
        cache.keep_view(KEY, _view())
        assert cache.view(KEY, (40, 39 - 30)) is None
        assert "features that the images do not have" in capsys.readouterr().err


@pytest.mark.parametrize(
    "entry",
    [
        Entry(entries.FEATURES, 2, 3, bytes(47)),
        Entry(entries.FEATURES, 2, 3, bytes(49)),
        Entry(entries.FEATURES, -1, 3, b""),
        Entry(entries.FEATURES, 1 << 40, 3, b""),
        Entry(entries.FEATURES, 0, 0, b""),
        Entry(entries.FEATURES, 2, 3, bytes(44) + np.float32(np.nan).tobytes()),
        Entry(entries.PAIR, 2, 3, bytes(48)),
    ],
)
def test_bytes_that_are_no_features_are_refused(entry):
    assert len(entries.to_features(Entry(entries.FEATURES, 2, 3, bytes(48)))) == 2
    with pytest.raises(EntryError):
        entries.to_features(entry)


@pytest.mark.parametrize(
    "entry",
    [
        Entry(entries.PAIR, 1, 0, bytes(79)),
        Entry(entries.PAIR, 1, 2, bytes(80)),
        Entry(entries.PAIR, 1, 4, bytes(80)),
        Entry(entries.PAIR, 0, 0, bytes(72)),
        Entry(entries.PAIR, -2, 0, b""),
        Entry(entries.PAIR, -1, 1, b""),
        Entry(entries.PAIR, -1, 0, b"x"),
        Entry(entries.PAIR, 1, 0, b"\xff" * 8 + bytes(72)),
        Entry(entries.PAIR, 1, 0, bytes(8) + b"\xff" * 72),
        Entry(entries.FEATURES, 1, 0, bytes(80)),
    ],
)
def test_bytes_that_are_no_pair_are_refused(entry):
    assert len(entries.to_view(Entry(entries.PAIR, 1, 0, bytes(80)), (1, 1)).matches) == 1
    with pytest.raises(EntryError):
        entries.to_view(entry, (1, 1))


def _garbage(path):
    path.write_bytes(b"not a database, but as long as one " * 4000)


def _cut_in_the_middle(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _another_layout(path):
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 7")
    db.close()


@pytest.mark.parametrize("harm", [_garbage, _cut_in_the_middle, _another_layout])
def test_a_damaged_file_is_put_aside_and_begun_anew(tmp_path, capsys, harm):
    with Cache(tmp_path) as cache:
        for n in range(100):
            cache.keep_features(_key(n), _features(200, seed=n))
    harm(tmp_path / FILE)
    before = (tmp_path / FILE).read_bytes()
    with Cache(tmp_path) as cache:
        found = [cache.features(_key(n)) for n in range(100)]
        assert found[-1] is None
        cache.keep_features(KEY, _features())
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "begun again" in lines[0]
    # Behind the header, which counts who wrote.
    assert (tmp_path / "mapping-1.damaged").read_bytes()[100:1000] == before[100:1000]
    with Cache(tmp_path) as cache:
        assert _same(cache.features(KEY), _features())
    assert not capsys.readouterr().err


def test_a_full_disk_is_said_once_and_what_is_on_disk_stays(tmp_path, capsys):
    with Cache(tmp_path) as cache:
        cache.keep_features(_key(0), _features(seed=0))
        cache.flush()
        pages = cache._db.execute("PRAGMA page_count").fetchone()[0]
        cache._db.execute(f"PRAGMA max_page_count = {pages + 10}")
        for n in range(1, 40):
            cache.keep_features(_key(n), _features(200, seed=n))
            cache.flush()
        assert cache.features(_key(0)) is None  # nothing is asked of a disk that refused
        assert cache.figures.features_made == 40
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "full" in lines[0] and "goes on without it" in lines[0]
    with Cache(tmp_path) as cache:
        assert _same(cache.features(_key(0)), _features(seed=0))


def test_a_folder_that_cannot_be_is_said_and_the_build_goes_on(tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    with Cache(tmp_path / "file" / "cache") as cache:
        cache.keep_features(KEY, _features())
        assert cache.features(KEY) is None
    (line,) = capsys.readouterr().err.splitlines()
    assert "goes on without it" in line and str(tmp_path / "file") in line


def test_two_builds_at_once_lose_nothing_of_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(caching, "_COMMIT_S", 0.0)  # every entry is a transaction
    start = threading.Barrier(2)

    def write(first):
        with Cache(tmp_path) as cache:
            start.wait()
            for n in range(first, first + 100):
                cache.keep_features(_key(n), _features(50, seed=n))

    threads = [threading.Thread(target=write, args=(first,)) for first in (0, 60)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    with Cache(tmp_path) as cache:
        for n in range(160):
            assert _same(cache.features(_key(n)), _features(50, seed=n))


def test_the_file_keeps_its_size_and_loses_what_was_not_used_for_longest(tmp_path, monkeypatch):
    clock = [1_000_000.0]
    monkeypatch.setattr(caching.time, "time", lambda: clock[0])
    bound = 1_000_000
    with Cache(tmp_path, bound) as cache:
        for n in range(60):  # 34 kB each
            clock[0] += 10_000
            cache.keep_features(_key(n), _features(450, seed=n))
            cache.flush()
            assert cache.features(_key(0)) is not None  # used all the time
            cache.flush()
        left = [n for n in range(60) if cache.features(_key(n))]
    assert left[0] == 0 and left[1:] == list(range(60 - len(left) + 1, 60))
    assert 20 <= len(left) <= 29
    assert (tmp_path / FILE).stat().st_size <= 1.1 * bound


CAMERA = THESIS_CAMERA
IMAGE = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)


def _keys(settings, camera=CAMERA, image=IMAGE):
    """The keys of an image, of a near and of a far pair."""
    how = content.extraction(
        extractors.create(settings.features, settings.max_features, learned=settings.learned),
        settings,
    )
    one, other = (content.features_key(picture, how) for picture in (image, image + 1))
    return [
        one,
        *(content.pair_key(one, other, key_of(rules_of(settings, far), camera))
          for far in (False, True)),
    ]  # fmt: skip


def _with(**changes):
    """Settings with changes, `match__ratio` of the table `match`."""
    settings = MappingSettings()
    for name, value in changes.items():
        table, _, key = name.rpartition("__")
        if table:
            value = dataclasses.replace(getattr(settings, table), **{key: value})
        settings = dataclasses.replace(settings, **{table or key: value})
    return settings


@pytest.mark.parametrize(
    ("changes", "touched"),
    [
        ({"max_features": 900}, [True, True, True]),
        ({"features": "orb"}, [True, True, True]),
        ({"match__ratio": 0.7}, [False, True, True]),
        ({"match__error_px": 2.0}, [False, True, True]),
        ({"match__planar_ratio": 0.8}, [False, True, True]),
        ({"match__min_inliers": 15}, [False, True, False]),
        ({"match__min_inliers_far": 40}, [False, False, True]),
        ({"match__min_inlier_ratio": 0.3}, [False, False, True]),
        ({"match__preview": 300}, [False, False, True]),
        ({"match__preview_matches": 6}, [False, False, True]),
        # These decide which pairs are compared, belong to what comes after, or to other features.
        ({"match__neighbours": 5}, [False, False, False]),
        ({"match__similar": 5}, [False, False, False]),
        ({"match__covisible": 5}, [False, False, False]),
        ({"match__ratio_others": 0.9}, [False, False, False]),
        ({"match__similar_others": 5}, [False, False, False]),
        ({"learned__threshold": 0.1}, [False, False, False]),
        ({"sfm__min_track": 4}, [False, False, False]),
        ({"seed": 5}, [False, False, False]),
        ({"threads": 3}, [False, False, False]),
        ({"cache_gb": 1.0}, [False, False, False]),
    ],
)
def test_a_changed_setting_touches_only_what_it_is_for(changes, touched):
    before, after = _keys(_with()), _keys(_with(**changes))
    assert [a != b for a, b in zip(before, after, strict=True)] == touched


def test_another_lens_is_another_pair_and_another_pixel_another_image():
    before = _keys(_with())
    lens = _keys(_with(), camera=dataclasses.replace(CAMERA, k1=0.16))
    assert [a != b for a, b in zip(before, lens, strict=True)] == [False, True, True]
    assert _keys(_with(), camera=dataclasses.replace(CAMERA, readout_s=0.01)) == before
    pixel = IMAGE.copy()
    pixel[10, 10] += 1
    assert all(a != b for a, b in zip(before, _keys(_with(), image=pixel), strict=True))
    assert _keys(_with(), image=IMAGE.reshape(64, 48))[0] != before[0]


def test_the_settings_of_a_learned_model_matter_to_its_features():
    class Learned:
        name, sha256, dimension, nms_px, threshold = "mine", "0" * 64, 64, 4, 0.01

    lines = {content.extraction(Learned(), _with())}
    Learned.threshold = 0.02
    lines.add(content.extraction(Learned(), _with()))
    lines.add(content.extraction(Learned(), _with(learned__provider="cuda")))
    assert len(lines) == 3
