#!/bin/sh
# Installs what the ground station needs: system packages from apt-packages.txt (root only for
# these), then the locked Python environment in .venv. Runs again in a second when nothing changed.
set -eu
cd "$(dirname "$0")/../.."
here=deploy/ground_station
say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$*" >&2; exit 2; }

# One setup at a time in this checkout, so that `make demo` and `make test` may start together.
mkdir -p out
if [ "${BLIMP_SETUP_LOCKED:-}" != 1 ] && command -v flock >/dev/null; then
  exec env BLIMP_SETUP_LOCKED=1 flock out/.setup.lock sh "$here/setup.sh"
fi

stamp=$(cat "$here/apt-packages.txt" requirements.lock pyproject.toml | sha256sum | cut -d' ' -f1)
sh deploy/packages.sh "$here/apt-packages.txt"

if [ "$(cat .venv/.stamp 2>/dev/null || true)" = "$stamp" ]; then exit 0; fi

python=
for candidate in ${PYTHON:-python3 python3.11 python3.12 python3.13}; do
  if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    python=$candidate; break
  fi
done
[ -n "$python" ] || die "Python 3.11 or newer is needed; found $(python3 --version 2>&1)"

say "Python environment in .venv from requirements.lock, with $($python --version)"
rm -f .venv/.stamp
"$python" -m venv .venv || die "'$python -m venv .venv' failed: is there space, and a complete Python?"
.venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --require-hashes \
  --no-compile -r requirements.lock
# On all cores, which pip does on one; files that are no Python of this version are no failure.
.venv/bin/python -m compileall -qq -j 0 .venv/lib >/dev/null || true
.venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --no-deps \
  --no-build-isolation -e .
echo "$stamp" >.venv/.stamp
say "done"
