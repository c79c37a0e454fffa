#!/bin/sh
# First process in user-mode Linux: gives the guest CAN, runs the script `command` in the host's directory $HIL_WORK,
# and says its status, upon which the guest is ended from outside. It sees the host's files, but can write to none of them.
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t tmpfs run /run
mkdir -p /dev/shm /run/tmp
mount -t tmpfs shm /dev/shm
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can net/can/can-raw net/can/can-bcm drivers/net/can/dev/can-dev drivers/net/can/vcan; do
  insmod "$modules/$module.ko" || echo "uml-init: $module.ko cannot be loaded"
done
ip link set lo up
sh "$HIL_WORK/command"
echo "uml-init: status $?"
exec sleep 1000000
