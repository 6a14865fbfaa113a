"""What a firewall does with a packet that comes from outside, as far as its rules can be read.

A packet is a protocol and a port that opens a new connection from an unknown address on an unknown
interface. Each condition of a rule is met, not met, or depends (None): on who sends, for one. A
rule that depends cannot decide; what it would do is remembered.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ACCEPT, DROP, JUMP, GOTO, RETURN, NEXT = "accept", "drop", "jump", "goto", "return", "next"
_DEEPEST = 32
_UNKNOWN = "unknown"
_FAMILIES = ("ip", "inet", "netdev")  # the video is IPv4


@dataclass(frozen=True)
class Rule:
    """`met` is None when it depends on what is not known; `target` is the chain of a jump."""

    met: bool | None
    verdict: str
    target: str = ""


@dataclass
class Chain:
    """Rules in their order; `policy` is what comes after the last one of a base chain."""

    rules: list[Rule] = field(default_factory=list)
    policy: str = ACCEPT
    base: bool = False
    """Whether packets that come in enter here."""


@dataclass(frozen=True)
class Fate:
    """What happens to the packet, and whether rules that depend could decide otherwise."""

    verdict: str
    depends: bool = False


@dataclass
class _Way:
    """Where a packet's way through a chain ends; `others`: where it could have ended before."""

    end: str
    others: set[str] = field(default_factory=set)


Chains = Mapping[str, Chain]


def judge(chains: Chains) -> Fate:
    """The packet's fate over all base chains: one that drops it is enough."""
    ends = []
    for name, chain in chains.items():
        if chain.base:
            way = _walk(chains, name, 0, {})
            verdict = chain.policy if way.end == NEXT else way.end
            ends.append(Fate(verdict, bool(way.others - {verdict})))
    dropped = [end for end in ends if end.verdict == DROP]
    if dropped:
        return Fate(DROP, all(end.depends for end in dropped))
    return Fate(ACCEPT, any(end.depends for end in ends))


def _walk(chains: Chains, name: str, depth: int, known: dict[str, _Way]) -> _Way:
    """A packet's way through a chain; it ends with `NEXT` where there is no verdict.

    `known` are the chains gone through already: many jumps to a few would else take for ever.
    """
    if name in known:
        return known[name]
    if name not in chains or depth > _DEEPEST:
        return _Way(NEXT, {_UNKNOWN})
    known[name] = _Way(NEXT, {_UNKNOWN})  # for a chain that comes back to itself
    known[name] = _through(chains, chains[name], depth, known)
    return known[name]


def _through(chains: Chains, chain: Chain, depth: int, known: dict[str, _Way]) -> _Way:
    others = set[str]()
    for rule in chain.rules:
        if rule.met is False or rule.verdict == NEXT:
            continue
        end = rule.verdict
        if end in (JUMP, GOTO):
            way = _walk(chains, rule.target, depth + 1, known)
            end = way.end
            others |= way.others
            if end == NEXT and rule.verdict == JUMP:
                continue
        elif end == RETURN:
            end = NEXT
        if rule.met is not None:
            return _Way(end, others)
        others.add(_UNKNOWN if end == NEXT else end)
    return _Way(NEXT, others)


def from_nft(document: str, protocol: str, port: int) -> dict[str, Chain]:
    """The chains of `nft -j list ruleset`; raises ValueError when it is not that.

    Tables that iptables made are left out: `from_iptables` reads them better.
    """
    entries = json.loads(document)["nftables"]
    foreign = {_table(entry["rule"]) for entry in entries if _xt(entry)}
    chains: dict[str, Chain] = {}
    for entry in entries:
        made = entry.get("chain") or {}
        if made and made["family"] in _FAMILIES and _table(made) not in foreign:
            base = made.get("hook") in ("input", "prerouting", "ingress")
            policy = DROP if made.get("policy") == "drop" else ACCEPT
            chains[_nft_name(made, made["name"])] = Chain(policy=policy, base=base)
    for entry in entries:
        made = entry.get("rule") or {}
        if made and (chain := chains.get(_nft_name(made, made["chain"]))) is not None:
            chain.rules.append(_nft_rule(made, protocol, port))
    return chains


def _table(made: Mapping[str, Any]) -> str:
    return f"{made['family']}/{made['table']}"


def _nft_name(made: Mapping[str, Any], chain: str) -> str:
    return f"{_table(made)}/{chain}"


def _xt(entry: Mapping[str, Any]) -> bool:
    return any("xt" in expression for expression in entry.get("rule", {}).get("expr", []))


def _nft_rule(made: Mapping[str, Any], protocol: str, port: int) -> Rule:
    met: bool | None = True
    for expression in made.get("expr", []):
        if not isinstance(expression, Mapping):
            continue
        (kind, value) = next(iter(expression.items()))
        if kind == "match":
            met = _and(met, _nft_match(value, protocol, port))
        elif kind in (ACCEPT, DROP, RETURN):
            return Rule(met, kind)
        elif kind == "reject":
            return Rule(met, DROP)
        elif kind in (JUMP, GOTO):
            return Rule(met, kind, _nft_name(made, value["target"]))
        elif kind == "vmap":
            return _nft_map(met, value, made, protocol, port)
        elif kind not in ("counter", "log", "mangle"):  # a limit, for one
            met = _and(met, None)
    return Rule(met, NEXT)


def _nft_map(
    met: bool | None, value: Mapping[str, Any], made: Mapping[str, Any], protocol: str, port: int
) -> Rule:
    """A map from what a packet has to verdicts; one that cannot be read may drop it."""
    data = value.get("data")
    pairs = data.get("set") if isinstance(data, Mapping) else None
    if not isinstance(pairs, Sequence) or isinstance(pairs, str):
        return Rule(None, DROP)
    for given, verdict in pairs:
        match = {"left": value.get("key"), "op": "==", "right": given}
        answer = _and(met, _nft_match(match, protocol, port))
        if answer is None:
            return Rule(None, DROP)
        if answer:
            return _nft_rule({**made, "expr": [verdict]}, protocol, port)
    return Rule(met, NEXT)


def _nft_match(match: Mapping[str, Any], protocol: str, port: int) -> bool | None:
    left, right, same = match.get("left"), match.get("right"), match.get("op") in ("==", "in")
    if not isinstance(left, Mapping):
        return None
    what = left.get("meta") or left.get("payload") or left.get("ct") or {}
    key = str(what.get("key") or what.get("field") or "")
    answer: bool | None = None
    if "payload" in left and what.get("protocol") in ("tcp", "udp", "th"):
        if what["protocol"] not in (protocol, "th"):
            return False
        answer = _in(right, port) if key == "dport" else None
    elif key in ("l4proto", "protocol", "nexthdr"):
        answer = _in(right, protocol) if key != "protocol" or "payload" in left else None
    elif key in ("iif", "iifname"):
        answer = False if right == "lo" else None
    elif "ct" in left and key == "state":
        answer, same = _in(right, "new"), True
        if match.get("op") == "!=":
            answer = None if answer is None else not answer
    return answer if answer is None or same else not answer


def _in(right: Any, value: str | int) -> bool | None:
    """Whether a value is in what nft calls a right side: one, a set, a range; None: not known."""
    if isinstance(right, Mapping):
        if "set" in right:
            return _in(right["set"], value)
        if "range" in right:
            low, high = right["range"]
            return isinstance(value, int) and low <= value <= high
        return None
    if isinstance(right, Sequence) and not isinstance(right, str):
        answers = [_in(item, value) for item in right]
        return True if True in answers else None if None in answers else False
    if isinstance(right, str) and right.startswith("@"):
        return None
    return right == value


def _and(one: bool | None, other: bool | None) -> bool | None:
    if one is False or other is False:
        return False
    return None if one is None or other is None else True


def from_iptables(saved: str, protocol: str, port: int) -> dict[str, Chain]:
    """The filter table's chains of `iptables-save`; raises ValueError when it is not that."""
    chains: dict[str, Chain] = {}
    table = ""
    for line in saved.splitlines():
        if line.startswith("*"):
            table = line[1:].strip()
        elif table == "filter" and line.startswith(":"):
            name, policy = line[1:].split()[:2]
            verdict = DROP if policy == "DROP" else ACCEPT
            chains[name] = Chain(policy=verdict, base=name == "INPUT")
        elif table == "filter" and line.startswith("-A "):
            words = shlex.split(line)
            rule = _iptables_rule(words[2:], protocol, port)
            chains.setdefault(words[1], Chain()).rules.append(rule)
    return chains


def _iptables_rule(words: list[str], protocol: str, port: int) -> Rule:
    met: bool | None = True
    position = 0
    while position < len(words):
        turned = words[position] == "!"
        position += turned
        option = words[position]
        value = words[position + 1] if position + 1 < len(words) else ""
        answer: bool | None = True
        if option in ("-j", "-g"):
            return _iptables_target(met, value, option)
        if option in ("-p", "--protocol"):
            answer = value in (protocol, "all")
        elif option in ("--dport", "--dports", "--destination-ports"):
            answer = any(_ported(part, port) for part in value.split(","))
        elif option in ("-i", "--in-interface"):
            answer = False if value == "lo" else None
        elif option in ("--ctstate", "--state"):
            answer = "NEW" in value.split(",")
        elif option == "--dst-type":
            answer = "LOCAL" in value.split(",")
        elif option in ("-m", "--match", "--comment"):
            turned = False
        else:
            answer = None
        if turned and answer is not None:
            answer = not answer
        met = _and(met, answer)
        position += 1
        while position < len(words) and not words[position].startswith(("-", "!")):
            position += 1
    return Rule(met, NEXT)


def _iptables_target(met: bool | None, target: str, option: str) -> Rule:
    known = {"ACCEPT": ACCEPT, "DROP": DROP, "REJECT": DROP, "RETURN": RETURN}
    if target in known:
        return Rule(met, known[target])
    if target in ("LOG", "NFLOG", "MARK", "CONNMARK", "TRACE"):
        return Rule(met, NEXT)
    return Rule(met, GOTO if option == "-g" else JUMP, target)


def _ported(part: str, port: int) -> bool:
    low, colon, high = part.partition(":")
    if not colon:
        return part == str(port)
    return int(low or 0) <= port <= int(high or 65535)
