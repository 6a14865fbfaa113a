"""`wpa_supplicant.conf` from checked values: no text of a user's stands in it, only hexadecimal.

So nothing in a name or password can end a quote, begin a line or be taken for a command.
"""

from __future__ import annotations

import hashlib
import re

from deploy.errors import DeployError
from deploy.provisioning.model import OPEN, WPA2, WPA3, Provisioning, Wifi

_HEAD = """\
# Written by the card from blimp.toml: changes made here are lost.
ctrl_interface=/run/wpa_supplicant
# Protected management frames where access point and radio have them: forged ones cut no link.
pmf=1
"""
_SECRET = re.compile(r"^\s*((?:psk|sae_password)=[0-9a-f]+)\s*$", re.ASCII | re.MULTILINE)
_SECRET_OF = {WPA2: "psk=", WPA3: "sae_password="}


def psk(password: str, ssid: bytes) -> str:
    """The pre-shared key as 64 hexadecimal digits (IEEE 802.11-2020, J.4.1): PBKDF2-SHA1."""
    return hashlib.pbkdf2_hmac("sha1", password.encode(), ssid, 4096, 32).hex()


def wpa_supplicant_conf(provisioning: Provisioning, stored: str = "") -> str:
    """The file for `wpa_supplicant`; empty when there is no Wi-Fi.

    With an empty password the secret is taken from `stored`, the file that the card holds, which
    is good for the same network (name and security) only: WPA2's key depends on the name. Raises
    `DeployError` when it is not there.
    """
    wifi = provisioning.wifi
    if wifi is None:
        return ""
    lines = [f"ssid={wifi.ssid.hex()}"]
    if wifi.hidden:
        lines.append("scan_ssid=1")
    if wifi.security == OPEN:
        lines.append("key_mgmt=NONE")
    else:
        # WPA3 asks for protected management frames, and some routers for one way of deriving the
        # password's element only: both are tried (sae_pwe=2).
        lines += ["proto=RSN", "pairwise=CCMP"]
        sae = ["key_mgmt=SAE", "ieee80211w=2"]
        # An access point that insists on protected frames may take a key by SHA-256 only.
        lines += sae if wifi.security == WPA3 else ["key_mgmt=WPA-PSK WPA-PSK-SHA256"]
        lines.append(_secret(wifi) if wifi.password else _kept(wifi, stored))
    element = "sae_pwe=2\n" if wifi.security == WPA3 else ""
    block = "".join(f"    {line}\n" for line in lines)
    return f"{_HEAD}country={wifi.country}\n{element}network={{\n{block}}}\n"


def _secret(wifi: Wifi) -> str:
    if wifi.security == WPA3:
        return f"sae_password={wifi.password.encode().hex()}"
    return f"psk={wifi.password.lower() if wifi.is_psk else psk(wifi.password, wifi.ssid)}"


def _kept(wifi: Wifi, stored: str) -> str:
    found = _SECRET.search(stored)
    same = re.search(rf"^\s*ssid={wifi.ssid.hex()}\s*$", stored, re.MULTILINE)
    if found is None or same is None or not found[1].startswith(_SECRET_OF[wifi.security]):
        raise DeployError(
            "'wifi.password' is empty, and the card holds none for this network and security:"
            " write it again"
        )
    return found[1]
