#!/bin/sh
# Installs what tests need. An sshd only where no init would start it: nobody's machine is to listen
# because of a test.
set -eu
set -- tests/apt-packages.txt
[ -d /run/systemd/system ] || set -- "$@" -
echo openssh-server | sh deploy/packages.sh "$@" \
  || echo "setup: tests that need these are skipped" >&2
