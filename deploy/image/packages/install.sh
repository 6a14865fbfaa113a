#!/bin/sh
# install.sh ROOT PACKAGE...: installs packages into a system's root by that system's own apt, from
# its own sources with its own keys. It is run in a mount namespace of its own, which takes what it
# mounts along; the root's programs may be another architecture's (packages/foreign.py).
set -eu
root=$1
shift

# Were the builder killed, this shell alone is told. apt and its children are one process group
# with it (Dpkg::Use-Pty is off), and must not go on in a folder that is no longer theirs.
trap 'trap "" TERM; kill -TERM 0; sleep 2; kill -KILL 0' TERM

mkdir -p "$root/proc" "$root/dev" "$root/tmp"
mount --rbind /proc "$root/proc"
mount -t tmpfs -o mode=755,size=1M none "$root/dev"
for name in null zero full random urandom; do
  : >"$root/dev/$name"
  mount --bind "/dev/$name" "$root/dev/$name"
done
ln -s /proc/self/fd "$root/dev/fd"
ln -s fd/0 "$root/dev/stdin"
ln -s fd/1 "$root/dev/stdout"
ln -s fd/2 "$root/dev/stderr"

# This machine's name servers; the base's file may be a link to what only runs there.
rm -f "$root/etc/resolv.conf"
[ ! -e /etc/resolv.conf ] || cp -L /etc/resolv.conf "$root/etc/resolv.conf"

# Nothing of it is started here. Its initramfs is not used, nor is the index of its manual, and
# making either takes minutes under emulation.
printf '#!/bin/sh\nexit 101\n' >"$root/usr/sbin/policy-rc.d"
chmod 755 "$root/usr/sbin/policy-rc.d"
if [ -e "$root/etc/initramfs-tools/update-initramfs.conf" ]; then
  echo update_initramfs=no >"$root/etc/initramfs-tools/update-initramfs.conf"
fi
rm -f "$root/var/lib/man-db/auto-update"

inside() {
  PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    chroot "$root" "$@" &
  wait $!
}

echo "I: reading what its sources have"
inside apt-get update -q
echo "I: downloading"
inside apt-get install -q -y --download-only "$@"
echo "I: installing"
inside apt-get install -q -y --no-download "$@"
