"""An image that fits another bay of a wall that repeats: moved where that is clear, else said."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.placing import elsewhere
from ground_station.mapping.construction.placing.elsewhere import Rival
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.settings import SfmSettings
from ground_station.mapping.sfm.two_view import TwoView

MATRIX = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
BAY_M = 6.0
N = 80


def camera(x_m: float) -> np.ndarray:
    return poses.pose(np.eye(3), [x_m, 0.0, 0.0])


def seen_from(x_m: float, points: np.ndarray) -> np.ndarray:
    local = points - [x_m, 0.0, 0.0]
    return local[:, :2] / local[:, 2:] * 500 + [320, 240]


def view(count: int) -> TwoView:
    matches = np.stack([np.arange(count)] * 2, axis=1).astype(np.int32)
    return TwoView(matches, np.eye(3), None, degenerate=False)


def wall(there: int) -> tuple[Placed, dict]:
    """Three images of a bay, two of the next one, and the last, of which the next bay's two say
    with `there` key points that it is theirs; it stands at the first."""
    rng = np.random.default_rng(3)
    first = rng.uniform([-2, -1, 4], [2, 1, 6], (N, 3))
    points = np.concatenate([first, first + np.array([BAY_M, 0, 0])])
    x_m = [0.0, 0.3, -0.3, BAY_M, BAY_M + 0.3, 0.1]
    own = [first, first, first, points[N:], points[N:], first]
    pixels = [seen_from(x, of) for x, of in zip(x_m, own, strict=True)]
    landmark = [np.arange(N)] * 3 + [np.arange(N, 2 * N)] * 2 + [np.arange(N)]
    model = Placed(
        landmark, {k: camera(x) for k, x in enumerate(x_m)}, points,
        np.array([500.0, 500.0, 320.0, 240.0]), pixels,
    )  # fmt: skip
    pairs = {(0, 1): view(N), (0, 2): view(N), (3, 4): view(N), (0, 5): view(N)}
    pairs |= {(3, 5): view(there), (4, 5): view(there)}
    return model, pairs


@pytest.mark.parametrize(("there", "doubtful"), [(20, False), (60, True)])
def test_an_image_that_fits_the_next_bay_nearly_as_well_is_doubtful(
    there: int, doubtful: bool
) -> None:
    model, pairs = wall(there)
    found = elsewhere.rivals(model, pairs)
    assert found[5] == Rival(here=N, there=there)
    assert found[5].doubtful is doubtful and not found[5].better
    said = elsewhere.doubt(found, [f"frame-{k}" for k in range(6)])
    assert any("frame-5" in line and "repeats itself" in line for line in said) is doubtful


def test_one_that_fits_the_next_bay_much_better_is_to_go_there() -> None:
    model, pairs = wall(60)
    model.landmark[5] = np.where(np.arange(N) < 25, np.arange(N), -1)
    assert elsewhere.rivals(model, pairs)[5] == Rival(here=25, there=60)
    assert Rival(25, 60).better and not Rival(60, 25).better and not Rival(60, 25).doubtful


def test_a_model_whose_pairs_hold_has_no_rival() -> None:
    model, pairs = wall(60)
    held = {pair: pairs[pair] for pair in pairs if pair not in ((3, 5), (4, 5))}
    assert elsewhere.rivals(model, held) == {}
    assert elsewhere.doubt({}, []) == []


def test_a_pair_that_breaks_by_a_drift_is_no_other_place() -> None:
    """Landmarks that stand twice, a little apart, place the image where it is."""
    model, pairs = wall(60)
    model.position[N:] = model.position[:N] + np.array([0.15, 0.0, 0.0])
    assert 5 not in elsewhere.rivals(model, pairs)


def test_what_several_images_say_alike_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV ends with an error when it draws one point twice."""
    model, pairs = wall(60)
    solve, drawn = elsewhere.cv2.solvePnPRansac, []

    def solved(points: np.ndarray, *rest: object, **named: object) -> object:
        drawn.append(points)
        return solve(points, *rest, **named)

    monkeypatch.setattr(elsewhere.cv2, "solvePnPRansac", solved)
    assert elsewhere.rivals(model, pairs)[5] == Rival(here=N, there=60)
    assert all(len(np.unique(points, axis=0)) == len(points) for points in drawn) and drawn


def row(moved: float, seen: int, images: int = 20) -> Placed:
    """Images along a wall, each of which sees so many landmarks; the last six are moved."""
    x_m = np.where(np.arange(images) < images - 6, 0.0, moved) + np.arange(images)
    points = np.random.default_rng(1).uniform([-2, -1, 4], [25, 1, 6], (N, 3))
    landmark = [np.arange(N)] * (images - 6) + [np.where(np.arange(N) < seen, 1, -1)] * 6
    wTc = {k: poses.pose(np.eye(3), [x, np.sin(k), 0.5 * np.cos(2 * k)]) for k, x in enumerate(x_m)}
    return Placed(landmark, wTc, points, np.array([500.0, 500.0, 320.0, 240.0]))


def test_images_that_another_model_has_elsewhere_are_doubtful_where_it_holds_them_as_well() -> None:
    model, last = row(0.0, N), set(range(14, 20))
    assert elsewhere.otherwise(model, [model, row(BAY_M, N)], seed=0) == last
    assert elsewhere.otherwise(model, [row(BAY_M, N // 2 - 1)], seed=0) == set()
    assert elsewhere.otherwise(model, [row(BAY_M, N, images=12)], seed=0) == set()
    said = elsewhere.otherwise_doubt(last, [f"frame-{k}" for k in range(20)])
    assert said == [
        "tried from another place, the same pairs put 6 images elsewhere nearly as well:"
        " frame-14, frame-15, frame-16, frame-17, frame-18 and 1 more"
    ]
    assert elsewhere.otherwise_doubt(set(), []) == []


def test_a_build_whose_tries_deny_each_other_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Model(SimpleNamespace):
        def reg_image_ids(self) -> list[int]:
            return [k + 1 for k in self.placed.wTc]

        def num_reg_images(self) -> int:
            return len(self.placed.wTc)

    solver = SimpleNamespace(
        wanted=SimpleNamespace(threads=1, smallest=5, seed=0),
        names=[f"frame-{k}" for k in range(30)],
        pairs={},
        placed=lambda model: model.placed,
        solve=lambda *_, **__: ([], []),
        settle=lambda *_: None,
        joined=lambda models, _: (models[:1], []),
    )
    monkeypatch.setattr(structure.contradictions, "rotations", lambda *_: {})
    monkeypatch.setattr(structure._Consistent, "_split", lambda _, models: models)
    pairs = {(k, k + 1): view(N) for k in range(29)}
    camera, sfm = SimpleNamespace(matrix=MATRIX), SfmSettings()
    images = SimpleNamespace(pinhole_px=[])
    for moved, doubts in ((BAY_M, 1), (0.0, 0)):
        judge = structure._Consistent(solver, pairs, images, camera, sfm)  # type: ignore[arg-type]
        spare = [Model(placed=row(moved, N))]
        said = judge.of([Model(placed=row(0.0, N))], [], spare, False)[2]  # type: ignore[list-item]
        assert len(said) == doubts
