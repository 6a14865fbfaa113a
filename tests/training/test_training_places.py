"""The losses on the detector's own peaks: what they measure, that extraction finds the same, and
that stepping down them brings two views' points together. With torch only."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training's tests need torch, an optional extra")

from ground_station.features import detection  # noqa: E402
from ground_station.training.losses import LossSettings, peak_losses, scores_of  # noqa: E402
from ground_station.training.peaks import highest, refined  # noqa: E402
from ground_station.training.views import Views  # noqa: E402

ROWS, COLUMNS = 64, 80
EYE = torch.eye(3)
KNOWN = torch.ones(2, 8, 10, dtype=torch.bool)


def shifted(by: float) -> Views:
    """The second view is the first one, so many pixels to the right."""
    second = torch.tensor([[1.0, 0, by], [0, 1, 0], [0, 0, 1]])
    both = torch.stack([EYE, second])
    return Views(torch.linalg.inv(both), both, torch.zeros(2), (ROWS, COLUMNS))


def logits(points: list[tuple[float, float]]) -> "torch.Tensor":
    """A view (1, 65, 8, 10) with narrow blobs at points x, y, px."""
    y, x = torch.meshgrid(torch.arange(ROWS), torch.arange(COLUMNS), indexing="ij")
    height = torch.full((ROWS, COLUMNS), -12.0)
    for px, py in points:
        height = torch.maximum(height, -((x - px) ** 2 + (y - py) ** 2) / 1.5)
    cells = torch.nn.functional.pixel_unshuffle(height[None, None], 8)
    return torch.cat([cells, torch.zeros(1, 1, 8, 10)], dim=1)


def described(offset: int = 0) -> "torch.Tensor":
    """Descriptors (1, 80, 8, 10): each cell's own, shifted by cells."""
    return torch.eye(80).view(1, 80, 8, 10).roll(offset, 3)


def losses_of(first, second, known=KNOWN, by=8.0, offset=1):
    """Descriptors', places' and reliability's."""
    both = torch.cat([logits(first), logits(second)])
    vectors = torch.cat([described(), described(offset)])
    return [v.item() for v in peak_losses(both, vectors, known, shifted(by), LossSettings())]


def test_peaks_are_those_of_extraction_and_refined_as_it_refines_them():
    scores = scores_of(torch.randn(2, 65, 8, 10, generator=torch.Generator().manual_seed(1)) * 3)
    pixels, values = highest(scores, 3, 4, 0.01, 500)
    for view in range(2):
        found = pixels[view][values[view] > 0].numpy()
        assert len(found) > 40
        rows, columns = detection.strongest(
            scores[view].numpy(), radius_px=3, threshold=0.01, border_px=4, most=500
        )
        theirs = set(zip(columns.tolist(), rows.tolist(), strict=True))
        # Greedy suppression keeps, beside the highest of all windows, what their fall set free.
        assert {(int(x), int(y)) for x, y in found} <= theirs
        wanted = detection.refined(scores[view].numpy(), found[:, 1], found[:, 0], radius_px=2)
        ours = refined(scores, pixels, 2)[view][values[view] > 0].numpy()
        assert np.abs(ours - wanted).max() < 1e-5


def test_the_loss_is_the_distance_that_is_left_in_the_second_view():
    at = [(20.0, 20.0), (36.0, 43.0)]
    there = [(x + 8, y) for x, y in at]
    assert losses_of(at, there)[1] < 0.02
    assert losses_of(at, [(x + 9, y) for x, y in there])[1] == 0  # 9 px: another point
    assert losses_of(at, [(x + 1, y) for x, y in there])[1] == pytest.approx(1, abs=0.1)
    moved = [there[0], (there[1][0], there[1][1] + 2)]
    assert losses_of(at, moved)[1] == pytest.approx(1, abs=0.1)


def test_unknown_cells_and_views_that_share_nothing_say_nothing():
    at = [(20.0, 20.0)]
    known = KNOWN.clone()
    known[0, 2, 2] = False
    assert losses_of(at, [(29.0, 20.0)])[1] > 0.5
    assert losses_of(at, [(29.0, 20.0)], known)[1] == 0
    assert losses_of(at, [(29.0, 20.0)], by=500.0) == [0, 0, 0]


def test_a_peak_is_of_use_where_the_other_view_has_it_and_its_descriptor_finds_it():
    at = [(20.0, 20.0), (36.0, 43.0)]
    there = [(x + 8, y) for x, y in at]
    found, _, useless = losses_of(at, there)
    confused, _, more = losses_of(at, there, offset=5)
    assert found < 0.1 < confused and useless < 0.1 < more
    alone = losses_of(at, there[:1])[2]
    assert 0.15 < alone < 0.6  # one of the first view's two has no partner


def test_down_the_gradient_two_views_points_come_together():
    both = torch.cat([logits([(20.0, 20.0), (37.4, 44.0)]), logits([(28.6, 20.5), (45.0, 44.6)])])
    both.requires_grad_(True)
    vectors = torch.cat([described(), described(1)])

    def loss():
        return peak_losses(both, vectors, KNOWN, shifted(8), LossSettings())[1]

    before = loss().item()
    assert 0.4 < before < 1
    optimizer = torch.optim.SGD([both], lr=2.0)
    for _ in range(40):
        optimizer.zero_grad()
        left = loss()
        left.backward()
        optimizer.step()
    assert left.item() < 0.3 * before
