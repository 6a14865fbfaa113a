"""The loss on key points' places: what it measures, that extraction refines the same, and that
stepping down it brings two views' points together. With torch only."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training's tests need torch, an optional extra")

from ground_station.features import detection  # noqa: E402
from ground_station.training.losses import peaks, place_loss, refined, scores_of  # noqa: E402

ROWS, COLUMNS = 64, 80
SHIFT = torch.tensor([[1.0, 0, 8.0], [0, 1, 0], [0, 0, 1]])[None]
"""The second view is the first one cell to the right."""


def logits(points: list[tuple[float, float]]) -> "torch.Tensor":
    """A view (1, 65, 8, 10) with narrow blobs at points x, y, px."""
    y, x = torch.meshgrid(torch.arange(ROWS), torch.arange(COLUMNS), indexing="ij")
    height = torch.full((ROWS, COLUMNS), -12.0)
    for px, py in points:
        height = torch.maximum(height, -((x - px) ** 2 + (y - py) ** 2) / 1.5)
    cells = torch.nn.functional.pixel_unshuffle(height[None, None], 8)
    return torch.cat([cells, torch.zeros(1, 1, 8, 10)], dim=1)


def loss_of(first, second, matrix=SHIFT, known=None):
    both = torch.cat([logits(first), logits(second)])
    known = torch.ones(2, 8, 10) if known is None else known
    return place_loss(both, known, matrix).item()


def test_peaks_are_refined_as_extraction_refines_them():
    scores = scores_of(torch.randn(2, 65, 8, 10, generator=torch.Generator().manual_seed(1)) * 3)
    pixels, good = peaks(scores, torch.ones(2, 8, 10))
    for view in range(2):
        found = pixels[view][good[view]].numpy()
        assert len(found) > 40
        wanted = detection.refined(scores[view].numpy(), found[:, 1], found[:, 0], radius_px=2)
        ours = refined(scores, pixels)[view][good[view]].numpy()
        assert np.abs(ours - wanted).max() < 1e-5


def test_the_loss_is_the_distance_that_is_left_in_the_second_view():
    at = [(20.0, 20.0), (36.0, 43.0)]
    there = [(x + 8, y) for x, y in at]
    assert loss_of(at, there) < 0.02
    beside = loss_of(at, [(x + 9, y) for x, y in there])
    assert beside == 0  # 9 px: another point
    assert loss_of(at, [(x + 1, y) for x, y in there]) == pytest.approx(1, abs=0.1)
    assert loss_of(at, [there[0], (there[1][0], there[1][1] + 2)]) == pytest.approx(1, abs=0.1)


def test_unknown_cells_and_views_that_share_nothing_say_nothing():
    at = [(20.0, 20.0)]
    known = torch.ones(2, 8, 10)
    known[0, 2, 2] = 0
    assert loss_of(at, [(29.0, 20.0)]) > 0.5
    assert loss_of(at, [(29.0, 20.0)], known=known) == 0
    behind = SHIFT.clone()
    behind[:, 2, 2] = -1
    assert loss_of(at, [(29.0, 20.0)], behind) == 0


def test_down_the_gradient_two_views_points_come_together():
    both = torch.cat([logits([(20.0, 20.0), (37.4, 44.0)]), logits([(28.6, 20.5), (45.0, 44.6)])])
    both.requires_grad_(True)
    known = torch.ones(2, 8, 10)
    before = place_loss(both, known, SHIFT)
    assert 0.4 < before.item() < 1
    optimizer = torch.optim.SGD([both], lr=2.0)
    for _ in range(40):
        optimizer.zero_grad()
        loss = place_loss(both, known, SHIFT)
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.3 * before.item()
