#!/bin/sh
# Takes QEMU 10 of Debian 13 into out/emulator (earlier ones time out on the Pi's I2C), unpacked and
# not installed: nothing of the system changes. Runs again in no time when nothing changed.
set -eu
cd "$(dirname "$0")/../../.."
room=out/emulator
say() { printf 'emulator: %s\n' "$*"; }
die() { printf 'emulator: %s\n' "$*" >&2; exit 2; }

stamp=$(sha256sum tests/hil/image/tools.sh | cut -d' ' -f1)
if [ "$(cat "$room/.stamp" 2>/dev/null || true)" = "$stamp" ]; then exit 0; fi
command -v mmdebstrap >/dev/null || die "needs mmdebstrap: sudo apt-get install mmdebstrap"

mkdir -p "$room"
rm -rf "$room/root" "$room/.stamp"
say "QEMU of Debian 13 in $room/root (under a minute, 170 MB)"
mmdebstrap --variant=extract --include=qemu-system-arm --aptopt='APT::Install-Recommends "false"' \
  trixie "$room/root" >"$room/log" 2>&1 || die "mmdebstrap failed; see $room/log"

# Its own loader and libraries, so that it needs neither a chroot nor root.
cat >"$room/qemu-system-aarch64" <<'EOF'
#!/bin/sh
usr=$(cd "$(dirname "$0")" && pwd)/root/usr
for loader in "$usr"/lib/*-linux-gnu/ld-linux-*.so.*; do
  exec "$loader" --library-path "${loader%/*}" "$usr/bin/qemu-system-aarch64" \
    -L "$usr/share/qemu" "$@"
done
EOF
chmod +x "$room/qemu-system-aarch64"
"$room/qemu-system-aarch64" --version >>"$room/log" 2>&1 || die "QEMU does not start; see $room/log"
echo "$stamp" >"$room/.stamp"
say "done"
