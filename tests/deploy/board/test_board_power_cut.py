"""Power goes before each single change of a provisioning, and the next boot comes to the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from board_cards import Cut, CutDisk, Person, certificates, renamed

from deploy.provisioning.text import parse, render


def first(person: Person) -> None:
    person.gives(keys=certificates(), settings="[gate]\nenabled = false\n")


def again(person: Person) -> None:
    """Another network and other certificates on a card that was provisioned before."""
    first(person)
    person.boots()
    person.gives(renamed("gym", "another password"), keys=certificates(mark="2"))


def longer(person: Person) -> None:
    """The file that is left is far longer than the one that was given."""
    text = (
        'schema=1\npayload.id="blimp-1"\n[wifi]\nssid="a"\npassword="private one"\ncountry="DE"\n'
    )
    person.gives(text.encode(), keys=certificates())


def settings_only(person: Person) -> None:
    first(person)
    person.boots()
    person.gives((person.card.boot / "blimp.toml").read_bytes(), settings="[gate]\n")


def cut_at_each_change(
    people: Callable[[], Person], given: Callable[[Person], None]
) -> Iterator[Person]:
    """A card after its power went before the first change, before the second, and so on."""
    count, whole = CutDisk(), people()
    given(whole)
    assert whole.boots(count).state == "in force"
    assert count.steps > 15
    for step in range(count.steps):
        person = people()
        given(person)
        with pytest.raises(Cut):
            person.boots(CutDisk(step))
        yield person


@pytest.mark.parametrize("given", [again, longer, settings_only])
def test_the_next_boot_comes_to_the_same(
    people: Callable[[], Person], given: Callable[[Person], None]
) -> None:
    whole = people()
    given(whole)
    whole.boots()
    wanted = relative(whole)
    for step, person in enumerate(cut_at_each_change(people, given)):
        outcome = person.boots()
        assert (outcome.state, outcome.payload_id, outcome.reason) == ("in force", "blimp-1", "")
        assert relative(person) == wanted, f"power went before change {step}"
        assert not person.holds_secret()


def test_power_goes_at_every_boot_once_more(people: Callable[[], Person]) -> None:
    """A card that is never left alone for long still gets there: each boot goes on."""
    whole = people()
    again(whole)
    whole.boots()
    person = people()
    again(person)
    for last in range(200):
        try:
            person.boots(CutDisk(last))
        except Cut:
            continue
        break
    assert relative(person) == relative(whole)


def test_something_whole_is_in_force_at_every_moment(people: Callable[[], Person]) -> None:
    """What the firmware would find after a cut and a boot whose new file is refused, too."""
    for person in cut_at_each_change(people, again):
        person.gives(b"nonsense")
        outcome = person.boots()
        assert outcome.state == "refused"
        assert outcome.payload_id == "blimp-1"
        keys = (person.card.blimp / "certificates/key.pem").read_bytes()
        assert keys in [certificates(mark=m)["key.pem"] for m in "12"]
        assert (person.card.blimp / "payload.toml").exists()


def test_a_persons_edit_between_two_boots_is_never_overwritten(
    people: Callable[[], Person],
) -> None:
    """The card was taken out after a power cut, and changed on a laptop."""
    for person in cut_at_each_change(people, first):
        other = certificates(mark="3")
        person.gives(render(renamed("edited", "and once more")).encode(), keys=other)
        assert person.boots().fresh
        assert parse((person.card.boot / "blimp.toml").read_bytes()) == renamed("edited")
        held = (person.card.blimp / "certificates/key.pem").read_bytes()
        assert held == other["key.pem"]
        assert not person.holds_secret()


def relative(person: Person) -> dict[str, bytes]:
    """The card's state without its own folder's name, which stands in payload.toml."""
    name = str(person.card.root).encode()
    return {key: value.replace(name, b"") for key, value in person.state().items()}
