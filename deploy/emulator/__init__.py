"""Boots the card image in QEMU: a Raspberry Pi 3 with camera, gauge and network, all emulated.

What it is not: the Pi's boot ROM and firmware (the kernel is handed over from the card's own boot
partition), its encoder, its radio, its hardware watchdog, and its pace.
"""
