"""A job within a job says nothing: a build in parts has one line of progress, not one a part."""

from __future__ import annotations

import threading

from ground_station.progress import Progress, silent


def _job(label):
    with Progress(label, 1) as progress:
        progress.step()


def test_what_runs_within_is_silent_in_its_own_thread_only(capsys):
    other = threading.Thread(target=_job, args=("beside",))
    with silent():
        _job("within")
        other.start()
        other.join()
    _job("after")
    said = capsys.readouterr().err
    assert "within" not in said and "beside: 1 in" in said and "after: 1 in" in said


def test_what_is_done_again_is_not_counted_beyond_the_total(capsys):
    with Progress("images of all tries", 2) as progress:
        for _ in range(5):
            progress.step()
    assert "images of all tries: 2 in" in capsys.readouterr().err
