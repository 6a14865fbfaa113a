"""The doctor reads firewalls: what is dropped, what passes, and what depends on who sends."""

import json

import pytest

from ground_station.doctor import firewall
from ground_station.doctor.firewall import ACCEPT, DROP, Fate


def match(left: object, right: object, op: str = "==") -> dict[str, object]:
    return {"match": {"op": op, "left": left, "right": right}}


UDP_PORT = {"payload": {"protocol": "udp", "field": "dport"}}
TCP_PORT = {"payload": {"protocol": "tcp", "field": "dport"}}
STATE = {"ct": {"key": "state"}}
LOOPBACK = match({"meta": {"key": "iif"}}, "lo")
ESTABLISHED = match(STATE, ["established", "related"], "in")
SOURCE = match({"payload": {"protocol": "ip", "field": "saddr"}}, "192.168.1.0/24")


def ruleset(*rules: list[object], policy: str = "drop", family: str = "inet") -> str:
    at = {"family": family, "table": "filter"}
    entries: list[object] = [{"metainfo": {"version": "1.0.6"}}, {"table": {"family": family}}]
    hook = {"type": "filter", "hook": "input", "prio": 0, "policy": policy}
    entries.append({"chain": {**at, "name": "input", **hook}})
    entries.append({"chain": {**at, "name": "services"}})
    for rule in rules:
        chain, expressions = ("input", rule) if rule[0] != "services" else ("services", rule[1:])
        entries.append({"rule": {**at, "chain": chain, "expr": expressions}})
    return json.dumps({"nftables": entries})


def nft(document: str, protocol: str = "udp", port: int = 5600) -> Fate:
    return firewall.judge(firewall.from_nft(document, protocol, port))


def test_no_rules_at_all_let_everything_pass() -> None:
    assert nft(json.dumps({"nftables": [{"metainfo": {}}]})) == Fate(ACCEPT)
    assert firewall.judge(firewall.from_iptables("", "udp", 5600)) == Fate(ACCEPT)


def test_chains_that_jump_to_each_other_without_end_are_gone_through_once() -> None:
    names = [f"c{number}" for number in range(9)]
    jumps = [f"-A {one} -j {other}" for one in names for other in names]
    rules = ["*filter", ":INPUT DROP [0:0]", "-A INPUT -j c0", *jumps]
    fate = firewall.judge(firewall.from_iptables("\n".join(rules), "udp", 5600))
    assert fate == Fate(DROP, depends=True)


def test_a_closed_host_drops_what_it_does_not_name() -> None:
    rules = ([LOOPBACK, {"accept": None}], [ESTABLISHED, {"accept": None}])
    assert nft(ruleset(*rules)) == Fate(DROP)
    opened = [match(UDP_PORT, 5600), {"counter": {"packets": 0, "bytes": 0}}, {"accept": None}]
    assert nft(ruleset(*rules, opened)) == Fate(ACCEPT)
    assert nft(ruleset(*rules, opened), port=5601) == Fate(DROP)
    assert nft(ruleset(*rules, opened), "tcp") == Fate(DROP)


@pytest.mark.parametrize(
    ("right", "passes"),
    [
        ({"set": [22, 5600]}, True),
        ({"set": [22, {"range": [5000, 6000]}]}, True),
        ({"range": [1, 1023]}, False),
        (5601, False),
    ],
)
def test_sets_and_ranges_of_ports(right: object, passes: bool) -> None:
    rule = [match(UDP_PORT, right), {"accept": None}]
    assert nft(ruleset(rule)) == Fate(ACCEPT if passes else DROP)


def test_a_rule_for_some_senders_only_depends() -> None:
    assert nft(ruleset([SOURCE, {"accept": None}])) == Fate(DROP, depends=True)
    assert nft(ruleset([SOURCE, {"drop": None}], policy="accept")) == Fate(ACCEPT, depends=True)
    # What would be decided anyway does not depend.
    assert nft(ruleset([SOURCE, {"accept": None}], policy="accept")) == Fate(ACCEPT)
    assert nft(ruleset([SOURCE, {"drop": None}])) == Fate(DROP)


def test_jumps_returns_and_rejects() -> None:
    jump = [{"jump": {"target": "services"}}]
    opened = ["services", match(UDP_PORT, 5600), {"accept": None}]
    assert nft(ruleset(jump, opened)) == Fate(ACCEPT)
    returned = ["services", {"return": None}]
    assert nft(ruleset(jump, returned, opened)) == Fate(DROP)
    rejected = [match(UDP_PORT, 5600), {"reject": {"type": "icmp"}}]
    assert nft(ruleset(rejected, policy="accept")) == Fate(DROP)


def test_a_chain_that_jumps_to_itself_is_not_followed_for_ever() -> None:
    jump = [{"jump": {"target": "services"}}]
    round_ = ["services", {"jump": {"target": "services"}}]
    assert nft(ruleset(jump, round_)).verdict == DROP


def test_maps_from_states_to_verdicts() -> None:
    def mapped(*pairs: list[object]) -> list[object]:
        return [{"vmap": {"key": STATE, "data": {"set": list(pairs)}}}]

    usual = mapped(["established", {"accept": None}], ["invalid", {"drop": None}])
    opened = [match(UDP_PORT, 5600), {"accept": None}]
    assert nft(ruleset(usual, opened)) == Fate(ACCEPT)
    assert nft(ruleset(usual)) == Fate(DROP)
    assert nft(ruleset(mapped(["new", {"drop": None}]), policy="accept")) == Fate(DROP)


def test_rules_for_ipv6_do_not_count_against_video_over_ipv4() -> None:
    assert nft(ruleset(family="ip6")) == Fate(ACCEPT)


SAVED = """\
*nat
:INPUT DROP [0:0]
COMMIT
*filter
:INPUT {policy} [0:0]
:FORWARD DROP [0:0]
:OUTPUT ACCEPT [0:0]
:ufw-user-input - [0:0]
-A INPUT -i lo -j ACCEPT
-A INPUT -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT
-A INPUT -m limit --limit 3/min -j LOG --log-prefix "[UFW BLOCK] "
-A INPUT -j ufw-user-input
{more}
COMMIT
"""


def saved(more: str = "", policy: str = "DROP", protocol: str = "udp") -> Fate:
    text = SAVED.format(policy=policy, more=more)
    return firewall.judge(firewall.from_iptables(text, protocol, 5600))


def test_iptables_and_ufw() -> None:
    assert saved() == Fate(DROP)
    assert saved(policy="ACCEPT") == Fate(ACCEPT)
    rule = "-A ufw-user-input -p udp -m udp --dport 5600 -j ACCEPT"
    assert saved(rule) == Fate(ACCEPT)
    assert saved(rule, protocol="tcp") == Fate(DROP)
    assert saved("-A INPUT -p udp -m multiport --dports 80,5500:5700 -j ACCEPT") == Fate(ACCEPT)
    assert saved("-A INPUT -p udp ! --dport 5600 -j ACCEPT") == Fate(DROP)
    assert saved('-A INPUT -m comment --comment "a word -j DROP" -j ACCEPT') == Fate(ACCEPT)
    assert saved("-A INPUT -j REJECT --reject-with icmp-port-unreachable", "ACCEPT") == Fate(DROP)
    source = saved("-A INPUT -s 10.0.0.0/8 -p udp --dport 5600 -j ACCEPT")
    assert source == Fate(DROP, depends=True)
