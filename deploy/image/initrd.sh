#!/bin/busybox sh
# The card's first program: finds the root by its UUID, mounts it read-only under a layer in memory
# and hands over to systemd. What fails is said on the console; then the board starts again, since
# nobody sits there with a keyboard.
# shellcheck shell=sh
export PATH=/bin
UPPER_SIZE=64m
WAIT_S=60
REBOOT_S=10

say() { echo "blimp initrd: $*" >/dev/console 2>/dev/null || echo "blimp initrd: $*"; }

fail() {
  say "$*; starting again in $REBOOT_S s"
  sleep "$REBOOT_S"
  reboot -f
  # No driver that can reset: the hardware watchdog or a hand has to.
  while :; do sleep 60; done
}

# 32 hex digits that stay with the board: of its serial number, or of the card's.
machine_id() {
  for source in /proc/device-tree/serial-number /sys/block/mmcblk*/device/cid; do
    [ -r "$source" ] || continue
    serial=$(tr -d '\000\n ' <"$source")
    # An emulated board's is all zeros.
    [ -n "$(echo "$serial" | tr -d 0)" ] || continue
    echo "blimp machine-id $serial" | sha256sum | cut -c1-32
    return
  done
  tr -d - </proc/sys/kernel/random/uuid
}

mkdir -p /proc /sys /dev /lower /layer /root
mount -t proc -o nosuid,nodev,noexec proc /proc || fail "no /proc"
mount -t sysfs -o nosuid,nodev,noexec sys /sys || fail "no /sys"
mount -t devtmpfs -o nosuid,mode=0755 dev /dev || fail "no /dev"
exec >/dev/console 2>&1 </dev/null

for module in /modules/*; do
  [ -e "$module" ] || continue
  insmod "$module" || say "${module##*/} does not load"
done

root=
# shellcheck disable=SC2013  # words, not lines
for word in $(cat /proc/cmdline); do
  case $word in root=*) root=${word#root=} ;; esac
done
[ -n "$root" ] || fail "the kernel's line names no root="

waited=0
until device=$(findfs "$root" 2>/dev/null) && [ -b "$device" ]; do
  [ "$waited" -lt $((WAIT_S * 5)) ] || fail "$root: not found in $WAIT_S s"
  waited=$((waited + 1))
  usleep 200000
done

mount -t ext4 -o ro,noatime "$device" /lower || fail "$device: no file system to mount"
mount -t tmpfs -o "size=$UPPER_SIZE,mode=0755" layer /layer || fail "no memory for the layer"
mkdir /layer/upper /layer/work
mount -t overlay -o lowerdir=/lower,upperdir=/layer/upper,workdir=/layer/work root /root \
  || fail "no overlay"
[ -x /root/usr/lib/systemd/systemd ] || fail "$device: no systemd in it"
machine_id >/root/etc/machine-id || fail "no machine-id"
chmod 444 /root/etc/machine-id

for place in proc sys dev; do
  mount --move "/$place" "/root/$place" || fail "/$place does not move"
done
# Should this one fail, the kernel loses its first program, and starts again by panic= of its line.
exec switch_root /root /usr/lib/systemd/systemd
