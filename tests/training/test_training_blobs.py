"""The losses on the views' own blobs: that they are extraction's, and what is right and what costs.
With torch only."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training's tests need torch, an optional extra")

from ground_station.feature_models import images  # noqa: E402
from ground_station.features import blobs, sampling  # noqa: E402
from ground_station.training import losses  # noqa: E402
from ground_station.training.losses import (  # noqa: E402
    LossSettings,
    anywhere_loss,
    blob_losses,
    likeness,
    sampled,
)
from ground_station.training.pairs import Batch  # noqa: E402
from ground_station.training.views import Views  # noqa: E402

ROWS, COLUMNS = 64, 80
AT = np.array([[20.3, 20.0], [44.0, 24.6], [36.0, 43.0], [58.0, 50.0]])


def test_blobs_are_those_of_extraction():
    size = (120, 160)
    for number in range(4):
        picture = images.procedural(5, number, size)
        ours = losses.responses(torch.from_numpy(picture)[None, None].float() / 255)
        theirs = blobs.responses(picture)
        assert np.abs(ours[0].numpy() - theirs).max() < 1e-5
        both = torch.from_numpy(theirs)[None]
        everywhere = torch.ones(1, *size, dtype=torch.bool)
        places, heights = losses.strongest(both, 2, 150, everywhere, torch.ones(1, *size))
        found, _ = blobs.strongest(theirs, 2, 150)
        kept = places[0][heights[0] > 0].numpy()
        assert len(kept) > 50
        gaps = np.linalg.norm(kept[:, None] - found[None], axis=2).min(axis=1)
        # Those that are none are left out before the strongest are counted, or after.
        assert np.mean(gaps < 1e-3) > 0.97 and abs(len(kept) - len(found)) < 6


def test_where_and_favour_choose_the_blobs():
    values = torch.zeros(1, 2, 64, 64)
    for (x, y), height in zip([(20, 20), (40, 20), (20, 40)], [0.3, 0.2, 0.1], strict=True):
        values[0, 1, y - 1 : y + 2, x - 1 : x + 2] = height / 2
        values[0, 1, y, x] = height
    where, favour = torch.ones(1, 64, 64, dtype=torch.bool), torch.ones(1, 64, 64)
    where[0, 20, 20] = False
    favour[0, 40, 20] = 9
    places, heights = losses.strongest(values, 2, 2, where, favour)
    assert places[0].tolist() == [[20, 40], [40, 20]] and heights[0].tolist() == [
        pytest.approx(0.1), pytest.approx(0.2),
    ]  # fmt: skip
    assert (losses.strongest(values, 2, 5, where, favour)[1][0, 2:] == 0).all()
    values[0, 0, 40, 20] = 0.15  # higher at the scale beside it
    found = losses.strongest(values, 2, 5, where, favour)
    assert found[0][0, 0].tolist() == [20, 40] and found[1][0, 0] == pytest.approx(0.15)
    assert (found[1][0] > 0).sum() == 2


def view(points: np.ndarray) -> "torch.Tensor":
    y, x = np.mgrid[:ROWS, :COLUMNS]
    picture = np.full((ROWS, COLUMNS), 0.3)
    for px, py in points:
        picture += 0.5 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 2.0**2))
    return torch.from_numpy(picture).float()[None]


def batch(first: np.ndarray, second: np.ndarray, by: float = 8.0, known=None) -> Batch:
    """The second view is the first one, so many pixels to the right."""
    shift = torch.tensor([[1.0, 0, by], [0, 1, 0], [0, 0, 1]])
    both = torch.stack([torch.eye(3), shift])
    views = Views(torch.linalg.inv(both), both, torch.zeros(2), (ROWS, COLUMNS))
    if known is None:
        known = torch.ones(2, 8, 10, dtype=torch.bool)
    points = torch.tensor([[[20.0, 20], [40, 30]], [[28.0, 20], [48, 30]]])
    return Batch(
        torch.stack([view(first), view(second)]), known, points,
        torch.ones(1, 2, dtype=torch.bool), torch.ones(2, ROWS, COLUMNS), views,
    )  # fmt: skip


def outputs(offset: int = 1, worth: float = 0.0):
    """Each cell's own descriptor, in the second view shifted by cells; no details."""
    own = torch.eye(80).view(1, 80, 8, 10)
    return (
        torch.cat([own, own.roll(offset, 3)]), torch.zeros(2, 4, 16, 20),
        torch.full((2, 1, 8, 10), worth),
    )  # fmt: skip


THERE = np.add(AT, (8, 0))


def test_descriptors_that_find_their_partners_cost_least():
    settings = LossSettings()
    found, _, right = blob_losses(outputs(), batch(AT, THERE), settings)
    confused, _, wrong = blob_losses(outputs(offset=4), batch(AT, THERE), settings)
    assert found < 0.1 < 2 < confused and right == 1 and wrong <= 0.5
    everywhere = anywhere_loss(outputs(), batch(AT, THERE), settings)
    assert everywhere < 0.1 < anywhere_loss(outputs(offset=4), batch(AT, THERE), settings)


def test_a_score_costs_where_the_blob_has_no_partner_or_its_descriptor_does_not_find_it():
    settings = LossSettings()
    high, low = outputs(worth=15.0), outputs(worth=-5.0)

    def worth(said, of):
        return float(blob_losses(said, of, settings)[1])

    whole = batch(AT, THERE)
    assert worth(high, whole) < 0.3 < worth(low, whole)
    lonely = batch(AT, np.add(THERE, (0, 9)))  # none is where it should be
    assert worth(low, lonely) < 0.3 < worth(high, lonely)
    confused = (outputs(offset=4)[0], *high[1:])
    assert worth(confused, whole) > 1


def test_what_is_not_known_and_views_that_share_nothing_say_nothing():
    settings = LossSettings()
    lonely = batch(AT, np.add(THERE, (0, 9)))
    assert blob_losses(outputs(), lonely, settings)[1] > 0
    known = torch.zeros(2, 8, 10, dtype=torch.bool)
    for of in (batch(AT, THERE, known=known), batch(AT, THERE, by=500.0)):
        assert [float(v) for v in blob_losses(outputs(), of, settings)] == [0, 0, 0]


def test_down_the_gradient_scores_and_descriptors_get_better():
    torch.manual_seed(1)
    said = [torch.randn(2, 10, 8, 10), torch.randn(2, 6, 16, 20), torch.zeros(2, 1, 8, 10)]
    for each in said:
        each.requires_grad_(True)
    of, settings = batch(AT, THERE), LossSettings()

    def both():
        found, worth, _ = blob_losses(tuple(said), of, settings)
        return found + worth

    before = both().item()
    optimizer = torch.optim.Adam(said, lr=0.1)
    for _ in range(60):
        optimizer.zero_grad()
        both().backward()
        optimizer.step()
    assert both().item() < 0.3 * before
    assert all((each.grad != 0).any() for each in said)


def test_likeness_is_a_chance_and_bars_what_shows_the_same():
    torch.manual_seed(0)
    one = torch.nn.functional.normalize(torch.randn(2, 20, 16), dim=2)
    points = torch.rand(2, 20, 2) * 300
    used = torch.ones(2, 20, dtype=torch.bool)
    target = torch.arange(20).expand(2, 20)

    def chance(first, second):
        said = likeness(first, second, points, points, used, target, 4.0, 0.06)
        assert said.exp().sum(dim=2) == pytest.approx(1, abs=1e-4)
        return float(said.gather(2, target[:, :, None]).exp().mean())

    assert chance(one, one) > 0.9 > 0.5 > chance(one, one[:, torch.randperm(20)])
    points[:, 1] = points[:, 0] + 1  # one place: none of the two is wrong
    same = one.clone()
    same[:, 1] = same[:, 0]
    assert chance(same, same) > 0.9
    points[:, 1] = points[:, 0] + 20
    assert chance(same, same) < 0.96  # two places that look alike are confused


def test_descriptors_are_sampled_as_the_extractor_samples_them():
    rng = np.random.default_rng(0)
    coarse = rng.standard_normal((8, 6, 9)).astype(np.float32)
    fine = rng.standard_normal((5, 12, 18)).astype(np.float32)
    points = rng.uniform(0, (71, 47), (40, 2)).astype(np.float32)
    said = (torch.from_numpy(coarse)[None], torch.from_numpy(fine)[None], torch.zeros(1, 1, 6, 9))
    ours = sampled(said, torch.from_numpy(points)[None])[0].numpy()
    parts = [
        sampling.bicubic(coarse, (points - 3.5) / 8),
        sampling.bicubic(fine, (points - 1.5) / 4),
    ]
    theirs, _ = sampling.unit(np.concatenate(parts, axis=1))
    assert ours == pytest.approx(theirs, abs=1e-4)
