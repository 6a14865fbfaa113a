"""The firmware's releases on the card: which one runs, how a new one comes, and the way back.

    /usr/lib/blimp/release/     pi_firmware/ site/ release.json: the image's, never written
    /data/releases/VERSION/     one that an update brought, with its list, manifest.json
    /data/releases/current      symbolic link to the one in force; absent: the image's
    /data/releases/previous     and to the one before it
    /data/releases/trial.json   a new release that has not shown yet that it works
    /data/releases/last.json    what became of the last update
    /data/state/starts.json     how often the release under trial was started

`current` changes in one rename, and each step before and after it can be repeated, so power may go
at any time. Only root writes releases; the firmware's user counts its starts.
"""
