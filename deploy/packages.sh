#!/bin/sh
# shellcheck disable=SC2086 # lists of names, split at blanks on purpose
# Installs what is missing of the Debian packages in the lists named, as root or with sudo; says so
# only when there is something to do.
#   packages.sh LIST…
set -eu
say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$*" >&2; exit 2; }

wanted=$(sed -e 's/#.*//' -e '/^[[:space:]]*$/d' "$@" | tr '\n' ' ')
missing=
for package in $wanted; do
  [ "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null || true)" = installed ] \
    || missing="$missing $package"
done
[ -n "$missing" ] || exit 0
command -v apt-get >/dev/null || die "needs these packages, and there is no apt-get here:$missing"
say "installing system packages:$missing"
if [ "$(id -u)" = 0 ]; then as_root=
elif command -v sudo >/dev/null; then as_root=sudo
else die "run once as root: apt-get install$missing"; fi
# The output is kept for when something fails; DPkg::Lock waits for another installation.
mkdir -p out
if ! { $as_root apt-get -o DPkg::Lock::Timeout=300 update \
    && $as_root env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 \
         install -y --no-install-recommends $missing; } >out/apt.log 2>&1 </dev/null; then
  tail -n 5 out/apt.log >&2
  die "apt-get failed; the whole output is in out/apt.log"
fi
