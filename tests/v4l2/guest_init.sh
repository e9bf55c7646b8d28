#!/bin/busybox sh
# First process of the guest: loads the drivers, mounts the host's files read-only beneath a tmpfs,
# runs run.sh from the folder shared with the host inside that, and switches the guest off.
/bin/busybox --install -s /bin
export PATH=/bin
mkdir -p /proc /sys /dev /lower /writable /merged /share
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs devtmpfs /dev
while read -r module; do
    [ "$module" = vivid.ko ] || insmod "/modules/$module" || echo "guest: $module did not load"
done < /modules/order
P9=trans=virtio,version=9p2000.L,msize=524288
mount -t 9p -o "$P9,ro,cache=loose" host /lower || echo "guest: no files of the host"
mount -t 9p -o "$P9" share /share || echo "guest: no shared folder"
# shellcheck disable=SC2046
insmod /modules/vivid.ko $(cat /share/vivid.options) || echo "guest: vivid did not load"
mount -t tmpfs tmpfs /writable
mkdir -p /writable/upper /writable/work
mount -t overlay -o lowerdir=/lower,upperdir=/writable/upper,workdir=/writable/work overlay /merged ||
    echo "guest: no overlay"
mount -t proc proc /merged/proc
mount -t sysfs sysfs /merged/sys
mount -t devtmpfs devtmpfs /merged/dev
mkdir -p /merged/dev/shm /merged/share
mount -t tmpfs tmpfs /merged/dev/shm
mount --bind /share /merged/share
ip link set lo up
cut -d ' ' -f 1 /proc/uptime > /share/booted_s
chroot /merged /bin/sh /share/run.sh
echo $? > /share/status
cut -d ' ' -f 1 /proc/uptime > /share/ended_s
sync
poweroff -f
