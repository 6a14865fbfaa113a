#!/bin/sh
# finish.sh ROOT: takes out of a root file system what is another in each build, belongs to one
# machine only, or came from the machine that built it.
set -eu
cd "$1"

# Each card makes its own: identity, randomness, SSH host keys.
: >etc/machine-id
rm -f var/lib/dbus/machine-id var/lib/systemd/random-seed var/lib/systemd/credential.secret
rm -f etc/ssh/ssh_host_*

# The builder's name, name servers and archives.
rm -f etc/hostname etc/resolv.conf
rm -rf etc/apt/sources.list.d/* etc/apt/preferences.d/*

# Logs, caches, backups, lists: with times and inode numbers in them.
find var/log -type f -delete
find var/cache -type f -delete
find var/lib/apt/lists -type f -delete 2>/dev/null || true
rm -f etc/passwd- etc/group- etc/shadow- etc/gshadow- etc/subuid- etc/subgid- etc/.pwd.lock
rm -f var/lib/dpkg/*-old var/lib/dpkg/lock var/lib/dpkg/lock-frontend var/lib/systemd/catalog/database
rm -rf run/* tmp/* var/tmp/*
