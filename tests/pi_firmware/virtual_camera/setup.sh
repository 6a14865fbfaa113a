#!/bin/sh
# Makes a Debian 13 in out/virtual_camera/root whose libcamera has the virtual pipeline (Debian 12's
# has none), so that `libcamera:` is run for real without a camera. Needs root, debootstrap and cc.
# Runs again in a second when nothing changed.
set -eu
cd "$(dirname "$0")/../../.."
here=tests/pi_firmware/virtual_camera
root=out/virtual_camera/root
say() { printf 'virtual camera: %s\n' "$*"; }
die() { printf 'virtual camera: %s\n' "$*" >&2; exit 2; }

stamp=$(cat "$here/setup.sh" "$here/virtual.yaml" "$here/dma_buffers.c" | sha256sum | cut -d' ' -f1)
if [ "$(cat out/virtual_camera/.stamp 2>/dev/null || true)" = "$stamp" ]; then exit 0; fi
[ "$(id -u)" = 0 ] || die "a root file system is made as root"
for tool in debootstrap cc; do
  command -v "$tool" >/dev/null || die "needs $tool (Debian packages debootstrap, gcc, libc6-dev)"
done

mkdir -p out/virtual_camera
rm -f out/virtual_camera/.stamp
if [ ! -e "$root/.base" ]; then
  rm -rf "$root"
  say "Debian 13 in $root (some minutes)"
  debootstrap --variant=minbase trixie "$root" http://deb.debian.org/debian \
    >out/virtual_camera/log 2>&1 || die "debootstrap failed; see out/virtual_camera/log"
  cp /etc/ssl/certs/ca-certificates.crt /etc/resolv.conf "$root/etc/" 2>/dev/null || true
  touch "$root/.base"
fi
say "libcamera and GStreamer"
printf '#!/bin/sh\nexit 101\n' >"$root/usr/sbin/policy-rc.d"
chmod +x "$root/usr/sbin/policy-rc.d"
{ chroot "$root" apt-get update && chroot "$root" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y --no-install-recommends \
    gstreamer1.0-libcamera libcamera-ipa libcamera-tools gstreamer1.0-plugins-base \
    gstreamer1.0-plugins-good gstreamer1.0-plugins-bad gstreamer1.0-plugins-ugly \
    gir1.2-gst-plugins-base-1.0 python3-gi python3-numpy \
    && chroot "$root" apt-get clean; } >>out/virtual_camera/log 2>&1 \
  || die "apt-get failed; see out/virtual_camera/log"
mkdir -p "$root/usr/share/libcamera/pipeline/virtual" "$root/usr/local/lib"
cp "$here/virtual.yaml" "$root/usr/share/libcamera/pipeline/virtual/"
cc -Wall -shared -fPIC -O1 -o "$root/usr/local/lib/dma_buffers.so" "$here/dma_buffers.c" -ldl

# What of Python is no package of Debian, for the Python of Debian 13.
.venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --upgrade \
  --target "$root/opt/blimp" --python-version 3.13 --only-binary=:all: --no-deps \
  $(grep -oE '^(eclipse-zenoh|mcap|lz4|zstandard|smbus2|pyserial|pymavlink)==[^ ;\\]+' requirements.lock)
echo "$stamp" >out/virtual_camera/.stamp
say "done"
