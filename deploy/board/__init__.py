"""What runs on the card beside the firmware: first boot, provisioning, the light, releases.

Standard library only; it lies on the card as the package `deploy` below /usr/lib/blimp, with
`deploy.provisioning` and `deploy.errors`. `root/` goes onto the card as it is.
"""
