#!/bin/sh
# Installs the ground station as a system service, and takes it away again.
#
#   service.sh install   [--root DIR] [--environment DIR]
#   service.sh uninstall [--root DIR] [--purge]
#
# --root DIR         into a folder (an image, a package) and not this machine; needs no root
# --environment DIR  a Python environment that is there already, instead of building one
# --purge            configuration, recordings and maps go, too
#
# An upgrade is another install: the new release is built beside the old one, must accept the
# configuration, and takes its place in one rename. Until then the old one runs.
set -eu
here=$(CDPATH='' cd -P "$(dirname "$0")" && pwd)
source=$(CDPATH='' cd -P "$here/../.." && pwd)
unit=blimp-station.service
user=blimp
say() { printf 'service: %s\n' "$*"; }
die() { printf 'service: %s\n' "$*" >&2; exit 2; }
usage() { sed -n '4,9s/^# *//p' "$here/service.sh" >&2; exit 2; }

action=${1:-}
case $action in install | uninstall) shift ;; *) usage ;; esac
root='' environment='' purge=''
given="$*"
while [ $# -gt 0 ]; do
  case $1 in
    --root) root=${2:-}; [ -d "$root" ] || die "--root '$root' is no folder"; shift 2
      root=$(CDPATH='' cd -P "$root" && pwd); [ "$root" != / ] || root= ;;
    --environment) environment=${2:-}; [ -x "$environment/bin/python" ] \
      || die "--environment '$environment' holds no bin/python"; shift 2
      environment=$(CDPATH='' cd -P "$environment" && pwd) ;;
    --purge) [ "$action" = uninstall ] || usage; purge=1; shift ;;
    *) usage ;;
  esac
done

if [ -z "$root" ]; then
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || die "run as root: sh $here/service.sh $action $given"
    say "asks for root: sudo sh $here/service.sh $action $given"
    # shellcheck disable=SC2086  # the words were given as such, and checked
    exec sudo -- sh "$here/service.sh" "$action" $given
  fi
  [ -d /run/systemd/system ] || die "systemd does not run here; blimp serve runs without it"
fi
umask 022

opt=$root/opt/blimp
etc=$root/etc/blimp
state=$root/var/lib/blimp
unit_file=$root/etc/systemd/system/$unit
users_file=$root/etc/sysusers.d/blimp.conf
limits_file=$root/etc/sysctl.d/60-blimp.conf
command=$root/usr/local/bin/blimp
changed=

# Copies a file ($1) beside its place ($2) and renames it, unless the same is there already.
put() {
  if cmp -s "$1" "$2" && [ "$(stat -c %a "$2")" = 644 ]; then return; fi
  mkdir -p "$(dirname "$2")"
  install -m 644 "$1" "$2.part"
  mv "$2.part" "$2"
  changed=1
  say "wrote $2"
}

# A symbolic link that is replaced in one rename.
point() {
  [ "$(readlink "$2" 2>/dev/null || true)" != "$1" ] || return 0
  rm -f "$2.part"
  ln -s "$1" "$2.part"
  mv -T "$2.part" "$2"
  changed=1
}

hash_of() { sha256sum | cut -c1-16; }

# What a release is made of, relative to the checkout.
contents() {
  find pi_firmware ground_station hw maps/atrium pyproject.toml requirements.lock README.md LICENSE \
    -name __pycache__ -prune -o -type f ! -name '*.pyc' -print | LC_ALL=C sort
}

# A Python that the service's user can run: not one in somebody's home.
find_python() {
  for candidate in ${PYTHON:-/usr/bin/python3 python3.11 python3.12 python3.13 python3}; do
    base=$("$candidate" -c 'import os, sys
sys.version_info >= (3, 11) and print(os.path.realpath(sys._base_executable))' 2>/dev/null) || base=
    case $base in '' | /root/* | /home/* | /run/user/*) continue ;; esac
    printf '%s\n' "$base"
    return
  done
  die "Python 3.11 or newer is needed outside of /home and /root; see PYTHON=PATH"
}

# Builds the environment of a lock once; releases with the same lock share it.
build_environment() {
  python=$(find_python)
  [ -x "$source/.venv/bin/python" ] || die "no environment in $source/.venv: run make setup first"
  lock=$(cd "$source" && .venv/bin/python -m ground_station.doctor.locked)
  key=$({ printf '%s\n' "$lock"; "$python" -VV; printf '%s\n' "$python"; } | hash_of)
  environment=$opt/environments/$key
  [ ! -f "$environment/.complete" ] || return 0
  say "building the Python environment $environment with $("$python" -V)"
  rm -rf "$environment"
  mkdir -p "$environment"
  "$python" -m venv "$environment" || die "'$python -m venv' failed: is there space, and a complete Python?"
  printf '%s\n' "$lock" >"$environment/requirements.lock"
  "$environment/bin/python" -m pip install -q --disable-pip-version-check --no-input \
    --require-hashes -r "$environment/requirements.lock" || die "pip failed; nothing was changed"
  : >"$environment/.complete"
  changed=1
}

launcher() {
  cat <<'END'
#!/bin/sh
# The blimp command of this release, with its environment and nothing of where it is called.
release=$(CDPATH='' cd -P "$(dirname "$(readlink -f "$0")")/.." && pwd)
export PYTHONPATH="$release" PYTHONSAFEPATH=1 PYTHONDONTWRITEBYTECODE=1 PYTHONNOUSERSITE=1
exec "$release/environment/bin/python" -m ground_station.cli "$@"
END
}

# Sets `release` to the folder of this checkout's release, which it makes unless it is there.
build_release() {
  id=$({ contents | tr '\n' '\0' | xargs -0 sha256sum; launcher; echo "$environment"; } | hash_of)
  release=$opt/releases/$id
  [ ! -d "$release" ] || return 0
  rm -rf "$opt"/releases/*.part
  mkdir -p "$release.part/bin"
  contents | tar -cf - -T - | tar -xf - -C "$release.part" --no-same-owner --no-same-permissions
  chmod -R u=rwX,go=rX "$release.part"
  launcher >"$release.part/bin/blimp"
  chmod 755 "$release.part/bin/blimp"
  ln -s "${environment#"$root"}" "$release.part/environment"
  "$environment/bin/python" -m compileall -q -s "$release.part" -p "${release#"$root"}" \
    "$release.part/ground_station" "$release.part/pi_firmware" "$release.part/hw"
  sync
  mv -T "$release.part" "$release"
  changed=1
  say "release $id in $release"
}

# The shipped configuration with this installation's folders and a token, and without the port that
# every web page in a browser here may read; one that is there is kept.
configure() {
  mkdir -p "$etc"
  if [ -f "$etc/station.toml" ]; then
    say "kept $etc/station.toml"
    return
  fi
  sed -e 's|^folder = "maps/atrium"|folder = "/var/lib/blimp/maps/atrium"|' \
    -e 's|^shelf = "maps"|shelf = "/var/lib/blimp/maps"|' \
    -e 's|^folder = "recordings"|folder = "/var/lib/blimp/recordings"|' \
    -e 's|^token_file = ""|token_file = "/var/lib/blimp/token"|' \
    -e '/^\[foxglove\]/,$s|^enabled = true|enabled = false|' \
    ground_station/service/station.toml >"$etc/station.toml.part"
  chmod 644 "$etc/station.toml.part"
  mv "$etc/station.toml.part" "$etc/station.toml"
  changed=1
  say "wrote $etc/station.toml"
}

# A release that refuses the configuration never takes the place of one that runs with it.
check_configuration() {
  PYTHONPATH=$release "$environment/bin/python" -B -m ground_station.service.settings \
    "$etc/station.toml" || die "the new release refuses $etc/station.toml; nothing was switched"
}

fill_state() {
  [ -d "$state" ] || changed=1
  mkdir -p "$state/recordings" "$state/maps"
  if [ ! -d "$state/maps/atrium" ]; then
    rm -rf "$state/maps/atrium.part"
    mkdir "$state/maps/atrium.part"
    (cd maps/atrium && find . -type f ! -name '*.mcap' | tar -cf - -T -) \
      | tar -xf - -C "$state/maps/atrium.part" --no-same-owner
    mv -T "$state/maps/atrium.part" "$state/maps/atrium"
    changed=1
  fi
  if grep -q '^token_file = "/var/lib/blimp/token"' "$etc/station.toml" && [ ! -s "$state/token" ]; then
    (umask 077 && "$environment/bin/python" -c 'import secrets; print(secrets.token_urlsafe(32))' \
      >"$state/token.part")
    mv "$state/token.part" "$state/token"
    changed=1
    say "made the token that dashboard and API ask for: sudo cat $state/token"
  fi
  [ "$(stat -c %a "$state")" = 750 ] || chmod 750 "$state"
  [ -n "$root" ] || chown -R "$user:$user" "$state"
}

# The release that runs and the one before it stay, with their environments.
prune() {
  before=$(readlink "$opt/previous" 2>/dev/null || true)
  for folder in "$opt"/releases/*; do
    case "releases/${folder##*/}" in "releases/$id" | "$before") ;; *) rm -rf "$folder" ;; esac
  done
  for folder in "$opt"/environments/*; do
    [ -d "$folder" ] || continue
    used=
    for link in "$opt"/releases/*/environment; do
      [ "$(readlink "$link")" != "${folder#"$root"}" ] || used=1
    done
    [ -n "$used" ] || rm -rf "$folder"
  done
}

link_command() {
  mkdir -p "$(dirname "$command")"
  case $(readlink "$command" 2>/dev/null || true) in
    /opt/blimp/*) ;;
    '') [ ! -e "$command" ] || { say "left $command alone: it is not ours"; return 0; } ;;
    *) say "left $command alone: it is not ours"; return 0 ;;
  esac
  point /opt/blimp/current/bin/blimp "$command"
}

# A machine that allows more than is asked for keeps what it has.
raise_limits() {
  wanted=$(sed -n 's/^net.core.rmem_max = //p' "$here/blimp-sysctl.conf")
  if [ -z "$root" ] && [ ! -f "$limits_file" ] \
    && [ "$(cat /proc/sys/net/core/rmem_max)" -ge "$wanted" ]; then
    return
  fi
  put "$here/blimp-sysctl.conf" "$limits_file"
  [ -n "$root" ] || sysctl -q -p "$limits_file" || say "net.core.rmem_max could not be raised"
}

install_service() {
  cd "$source"
  mkdir -p "$opt/releases"
  # One installation at a time.
  exec 9>>"$opt/.lock"
  flock -n 9 || die "another installation runs"
  [ -n "$environment" ] || build_environment
  build_release
  configure
  check_configuration
  put "$here/blimp-sysusers.conf" "$users_file"
  [ -n "$root" ] || systemd-sysusers "$users_file"
  raise_limits
  fill_state
  old=$(readlink "$opt/current" 2>/dev/null || true)
  [ -z "$old" ] || [ "$old" = "releases/$id" ] || point "$old" "$opt/previous"
  point "releases/$id" "$opt/current"
  link_command
  put "$here/$unit" "$unit_file"
  prune
  if [ -n "$root" ]; then
    mkdir -p "$root/etc/systemd/system/multi-user.target.wants"
    point "../$unit" "$root/etc/systemd/system/multi-user.target.wants/$unit"
  else
    systemctl daemon-reload
    systemctl enable -q "$unit"
    if [ -n "$changed" ] || ! systemctl is-active -q "$unit"; then
      systemctl restart "$unit" || die "it does not start: journalctl -u $unit -n 50"
      say "runs: systemctl status $unit"
    fi
  fi
  if [ -z "$changed" ]; then say "nothing to change"; return; fi
  say "configuration in $etc/station.toml; then: systemctl restart $unit"
  say "for payloads on the network: the block at the top of that file"
  say "to look at what may hinder it: blimp doctor --config /etc/blimp/station.toml"
}

uninstall_service() {
  [ -n "$root" ] || [ ! -f "$unit_file" ] || systemctl disable -q --now "$unit"
  for path in "$unit_file" "$unit_file.d" "$users_file" "$limits_file" "$opt" \
    "$root/etc/systemd/system/multi-user.target.wants/$unit"; do
    if [ -e "$path" ] || [ -L "$path" ]; then
      rm -rf "$path"
      say "removed $path"
    fi
  done
  case $(readlink "$command" 2>/dev/null || true) in
    /opt/blimp/*) rm "$command"; say "removed $command" ;;
  esac
  if [ -z "$root" ]; then
    systemctl daemon-reload
    systemctl reset-failed "$unit" 2>/dev/null || true
  fi
  if [ -n "$purge" ]; then
    rm -rf "$etc" "$state"
    say "removed $etc and $state"
    if [ -z "$root" ] && id "$user" >/dev/null 2>&1; then
      userdel "$user" && say "removed the user $user"
    fi
    return
  fi
  for path in "$etc" "$state"; do
    [ ! -e "$path" ] || say "kept $path; uninstall --purge removes it"
  done
  if [ -z "$root" ] && id "$user" >/dev/null 2>&1; then
    say "kept the user $user, whose they are"
  fi
}

case $action in install) install_service ;; uninstall) uninstall_service ;; esac
exit  # what a checkout changes in this file meanwhile is not read
