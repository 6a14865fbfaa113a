"""Views and pairs: what training calls true must be. With torch only."""

from dataclasses import fields, replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training's tests need torch, an optional extra")

from ground_station.feature_models import images  # noqa: E402
from ground_station.features.methods.rootsift import RootSift  # noqa: E402
from ground_station.training import loop, pairs, views  # noqa: E402
from ground_station.training.degradation import degraded  # noqa: E402
from ground_station.training.views import Chance, Views  # noqa: E402

PICTURE, VIEW = (192, 256), (96, 128)
CPU = torch.device("cpu")


def spots(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Round spots at points (N, 2), a background in between."""
    y, x = np.mgrid[: size[0], : size[1]]
    result = np.full(size, 30.0)
    for px, py in points:
        result += 200 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 2.0**2))
    return result.clip(0, 255).astype(np.uint8)


def centre_near(picture: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The centre of what is bright within five pixels of a point."""
    x0, y0 = np.rint(point).astype(int)
    y, x = np.mgrid[y0 - 5 : y0 + 6, x0 - 5 : x0 + 6]
    weight = np.maximum(picture[y, x].astype(float) - 40, 0)
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("lens", [False, True])
def test_a_point_and_its_image_agree(lens):
    at = np.stack(np.meshgrid([60, 100, 140, 190], [50, 90, 130]), axis=-1).reshape(-1, 2)
    made = views.pairs_of_views(Chance(CPU, 1), 40, PICTURE, VIEW, lens)
    assert (made.lens > 0).any() == lens
    picture = torch.from_numpy(spots(at, PICTURE)).float().expand(80, -1, -1)
    taken = made.taken(picture).numpy()
    there = made.of_picture(torch.from_numpy(at).float().expand(80, -1, -1))
    back = made.onto_picture(there)
    seen = views.inside(there, VIEW, 8)
    assert (back - torch.from_numpy(at)).abs()[seen].max() < 0.05
    gaps = [
        np.abs(centre_near(view, point) - point).max()
        for view, points, good in zip(taken, there.numpy(), seen.numpy(), strict=True)
        for point in points[good]
    ]
    # A spot seen at a slant has its centre a little off that of its picture.
    assert len(gaps) > 150 and np.quantile(gaps, 0.95) < 0.45 and np.median(gaps) < 0.15


def test_a_plane_seen_straight_is_scaled_turned_and_shifted():
    def seen(points: list[list[float]], scale: float, roll: float, tilt: float) -> np.ndarray:
        one = torch.ones(1)
        matrix = views.of_planes(
            PICTURE, VIEW, torch.tensor([[100.0, 80.0]]), scale * one, roll * one, tilt * one,
            90 * one, 0 * one,
        )  # fmt: skip
        view = Views(matrix, torch.linalg.inv(matrix), 0 * one, VIEW)
        middle = torch.tensor([(VIEW[1] - 1) / 2, (VIEW[0] - 1) / 2])
        return view.onto_picture(middle + torch.tensor(points)[None])[0].numpy()

    straight = seen([[0.0, 0.0], [10.0, 0.0]], 2, 90, 0)
    assert straight == pytest.approx(np.array([[100, 80], [100, 100]]), abs=1e-3)
    tilted = seen([[0.0, 0.0], [-30.0, 0.0], [30.0, 0.0]], 1, 0, 40)
    assert tilted[0] == pytest.approx([100, 80], abs=1e-3)
    steps = np.abs(tilted[1:, 0] - 100)
    assert max(steps) / min(steps) > 1.2  # one side is farther away


def test_points_behind_the_horizon_are_nowhere():
    matrix = torch.tensor([[[1, 0, 0], [0, 1, 0], [0, -0.02, 1.0]]])
    view = Views(matrix, matrix, torch.zeros(1), (100, 100))
    seen = view.onto_picture(torch.tensor([[[10.0, 10.0], [10.0, 90.0]]]))
    assert seen.isfinite().all()
    assert views.inside(seen, (100, 100))[0].tolist() == [True, False]


def test_degrading_moves_nothing_and_is_a_function_of_its_seed():
    at = np.array([[40, 30], [90, 60]])
    picture = torch.from_numpy(spots(at, VIEW)).float().expand(40, -1, -1) / 255
    made = degraded(picture, Chance(CPU, 2))
    assert made.shape == picture.shape and made.min() >= 0 and made.max() <= 1
    assert (made == degraded(picture, Chance(CPU, 2))).all()
    assert (made != degraded(picture, Chance(CPU, 3))).any()
    y, x = np.mgrid[-12:13, -12:13]
    offs = []
    for one in made.numpy():
        for px, py in at:
            patch = one[py - 12 : py + 13, px - 12 : px + 13]
            weight = np.maximum(
                patch - np.median(patch) - 0.5 * np.ptp(patch - np.median(patch)), 0
            )
            if weight.sum() > 0:
                offs.append([(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()])
    assert len(offs) > 60 and np.abs(np.median(offs, axis=0)).max() < 0.3


def places() -> pairs.Places:
    picture = images.procedural(9, 2, PICTURE)
    pictures = torch.from_numpy(np.stack([picture, 255 - picture]))
    return pairs.Places(pictures, torch.tensor([[0, 1]]))


def test_a_batch_has_fixed_shapes_and_true_correspondences():
    batch = pairs.make(places(), Chance(CPU, 5), 12, VIEW, 48)
    assert batch.images.shape == (24, 1, *VIEW) and batch.favour.min() > 0
    assert batch.points_px.shape == (24, 48, 2) and batch.used.sum() > 12 * 24
    moved = batch.views.across(batch.points_px[::2], 0)
    assert (moved - batch.points_px[1::2])[batch.used].abs().max() < 1e-2
    assert views.inside(batch.points_px[1::2], VIEW, 3.9)[batch.used].all()
    assert batch.known.any(dim=(1, 2)).all() and not batch.known.all()
    first = batch.used.sum(dim=1, keepdim=True) > torch.arange(48)
    assert (first == batch.used).all()


def test_the_same_seed_gives_the_same_batch():
    def made(step: int) -> pairs.Batch:
        return pairs.make(places(), Chance(CPU, 3, step), 2, VIEW, 32)

    first, again, other = made(7), made(7), made(8)
    names = [field.name for field in fields(first) if field.name != "views"]
    assert all((getattr(first, k) == getattr(again, k)).all() for k in names)
    assert (first.images != other.images).any()


def test_the_figures_of_validation_are_those_of_the_truth():
    size = (120, 160)
    picture = images.procedural(9, 2, size)
    shifted = np.roll(picture, (4, -6), axis=(0, 1))
    both = torch.from_numpy(np.stack([picture, shifted]))[:, None].float() / 255
    matrix = torch.tensor([[1, 0, -6], [0, 1, 4], [0, 0, 1.0]])
    eye = torch.eye(3)
    truth = Views(torch.stack([eye, eye]), torch.stack([eye, matrix]), torch.zeros(2), size)
    batch = replace(pairs.make(places(), Chance(CPU, 1), 1, VIEW, 32), images=both, views=truth)
    right = loop.figures_of(RootSift(200), batch)
    assert right.accuracy > 0.9 and right.repeatability > 0.8 and right.correct > 20
    assert right.error_px < 0.1
    # A truth that is wrong by 20 px makes all of it chance.
    off = matrix + torch.tensor([[0, 0, 20.0], [0, 0, 0], [0, 0, 0]])
    wrong = replace(batch, views=replace(truth, from_picture=torch.stack([eye, off])))
    chance = loop.figures_of(RootSift(200), wrong)
    assert chance.accuracy < 0.2 and chance.error_px > 0.5
