#!/bin/sh
# Installs what tests need, and unpacks an sshd into out/sshd without installing it.
set -eu
sh deploy/packages.sh tests/apt-packages.txt || echo "setup: tests that need these are skipped" >&2
if command -v sshd >/dev/null || [ -x /usr/sbin/sshd ] || [ -x out/sshd/usr/sbin/sshd ]; then
  exit 0
fi
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
if ! { (cd "$folder" && apt-get -q download openssh-server) \
    && dpkg-deb -x "$folder"/*.deb out/sshd; } >out/sshd.log 2>&1; then
  echo "setup: no sshd; its tests are skipped (out/sshd.log says why)" >&2
fi
