#!/bin/sh
# Sets up what `make test-v4l2` needs beside `make setup`: an emulator, a kernel with the vivid driver
# and a small initial file system. Nothing is installed from the kernel's package; it is unpacked into
# build/v4l2. Idempotent. Where something cannot be had, build/v4l2/unavailable says why, and the
# tests are skipped with that sentence.
set -eu
cd "$(dirname "$0")/.."
OUT="$(pwd)/build/v4l2"
mkdir -p "$OUT"
STAMP="$(cat tools/setup_v4l2.sh tests/v4l2/guest_init.sh | cksum)"

give_up() {
    echo "setup_v4l2: $1" >&2
    echo "$1" > "$OUT/unavailable"
    exit 0
}

PACKAGES=""
need_command() {  # need_command COMMAND DEBIAN_PACKAGE
    PATH="$PATH:/sbin:/usr/sbin" command -v "$1" >/dev/null 2>&1 || PACKAGES="$PACKAGES $2"
}
need_command qemu-system-x86_64 qemu-system-x86
need_command busybox busybox-static
need_command cpio cpio
need_command modprobe kmod
need_command xz xz-utils
if [ -z "$PACKAGES" ] && [ -f "$OUT/guest.cpio.gz" ] && [ -f "$OUT/vmlinuz" ] &&
    [ "$(cat "$OUT/stamp" 2>/dev/null)" = "$STAMP" ]; then
    rm -f "$OUT/unavailable"
    exit 0
fi
rm -f "$OUT/unavailable" "$OUT/stamp"
[ "$(uname -m)" = x86_64 ] || give_up "the guest's kernel is for x86-64, this machine is $(uname -m)"
[ "$(id -u)" -eq 0 ] || give_up "the guest reads the host's files as root, and this user is not root"
command -v apt-get >/dev/null 2>&1 || give_up "the guest's kernel comes by apt-get, which is not here"
PATH="$PATH:/sbin:/usr/sbin"

if [ -n "$PACKAGES" ]; then
    echo "setup_v4l2: installing system packages:$PACKAGES" >&2
    apt-get update -qq || give_up "apt-get update failed"
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $PACKAGES >/dev/null ||
        give_up "apt-get could not install:$PACKAGES"
fi
if ldd "$(command -v busybox)" >/dev/null 2>&1; then
    give_up "busybox is not static; install busybox-static"
fi

kernel_package() {  # the kernel that apt offers, by the package that follows it
    apt-cache depends linux-image-amd64 2>/dev/null |
        sed -n 's/.*Depends: \(linux-image-[0-9][^ ]*\).*/\1/p' | head -n 1
}
PACKAGE="$(kernel_package)"
if [ -z "$PACKAGE" ]; then
    apt-get update -qq || give_up "apt-get update failed"
    PACKAGE="$(kernel_package)"
fi
[ -n "$PACKAGE" ] || give_up "apt offers no linux-image-amd64"
rm -rf "$OUT/kernel" "$OUT/guest"
mkdir -p "$OUT/kernel" "$OUT/guest/bin" "$OUT/guest/modules"
echo "setup_v4l2: fetching $PACKAGE (about 70 MB, unpacked and not installed)" >&2
fetch() { (cd "$OUT/kernel" && apt-get download -qq "$PACKAGE" 2>/dev/null); }
# A list of packages that is some weeks old names versions that are gone.
fetch || { apt-get update -qq && fetch; } || give_up "apt-get could not download $PACKAGE"
dpkg-deb -x "$OUT"/kernel/*.deb "$OUT/kernel" || give_up "$PACKAGE could not be unpacked"
rm -f "$OUT"/kernel/*.deb
VERSION="$(basename "$OUT"/kernel/boot/vmlinuz-*)"
VERSION="${VERSION#vmlinuz-}"
cp "$OUT/kernel/boot/vmlinuz-$VERSION" "$OUT/vmlinuz"
depmod -b "$OUT/kernel" "$VERSION" || give_up "depmod failed on $PACKAGE"

# In the order in which they must be loaded, each once.
for wanted in virtio_pci 9pnet_virtio 9p overlay vivid; do
    modprobe -d "$OUT/kernel" -S "$VERSION" --show-depends "$wanted" ||
        give_up "$PACKAGE has no module $wanted"
done | sed -n 's/^insmod \([^ ]*\).*/\1/p' | awk '!seen[$0]++' > "$OUT/modules"
[ -f "$OUT/unavailable" ] && exit 0
grep -q vivid "$OUT/modules" || give_up "$PACKAGE has no module vivid"
while read -r path; do
    name="$(basename "$path")"
    case "$name" in
        *.xz) xz -dc "$path" > "$OUT/guest/modules/${name%.xz}" ;;
        *) cp "$path" "$OUT/guest/modules/$name" ;;
    esac
    echo "${name%.xz}" >> "$OUT/guest/modules/order"
done < "$OUT/modules"

cp "$(command -v busybox)" "$OUT/guest/bin/busybox"
cp tests/v4l2/guest_init.sh "$OUT/guest/init"
chmod 755 "$OUT/guest/init"
(cd "$OUT/guest" && find . | cpio -o -H newc --quiet | gzip -1) > "$OUT/guest.cpio.gz"
rm -rf "$OUT/kernel" "$OUT/guest"
echo "$STAMP" > "$OUT/stamp"
echo "setup_v4l2: done, kernel $VERSION" >&2
