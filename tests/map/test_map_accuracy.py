"""A map's own errors, of map.toml, as a covariance of the poses that are found in it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground_station.errors import MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.map.store import MapInfo
from ground_station.map.uncertainty import Accuracy, Uncertainty, accuracy

POSE = poses.pose(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([6.0, -2.0, 1.5]))
SIGMA = np.array([1e-3, 2e-3, 5e-4, 4e-3, 6e-3, 2e-3, 1e-3])
ABOUT = np.array([1.0, 3.0, 0.5])


def info(frame: str = "world", **registration: object) -> MapInfo:
    return MapInfo("rootsift", "0" * 64, 128, THESIS_CAMERA, frame=frame, registration=registration)


def test_a_pose_inherits_what_a_registration_is_off():
    rng = np.random.default_rng(5)
    root = np.linalg.qr(rng.normal(size=(7, 7)))[0] * SIGMA  # of a covariance that is not diagonal
    drawn = (root @ rng.normal(size=(7, 20000))).T
    errors = []
    for step in drawn:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        place = ABOUT + np.exp(step[6]) * turn @ (POSE[:3, 3] - ABOUT) + step[3:6]
        errors.append(poses.log(poses.inverse(POSE) @ poses.pose(turn @ POSE[:3, :3], place)))
    known = Uncertainty(root @ root.T, ABOUT, 9)
    expected = Accuracy(registration=known).at(POSE)
    scale = np.sqrt(np.diag(expected))
    off = (np.cov(np.array(errors).T) - expected) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.05


def test_of_few_points_the_ellipsoid_holds_what_it_says():
    rng = np.random.default_rng(7)
    for freedom in (5, 11, 2000):  # known from so many residuals of 1 cm
        square = rng.chisquare(freedom, 20000) / freedom
        off = rng.normal(size=(20000, 3))
        table = {
            "covariance": np.diag([0, 0, 0, 1, 1, 1, 0]).tolist(),
            "covariance_about_m": POSE[:3, 3].tolist(),
            "degrees_of_freedom": freedom,
        }
        known = accuracy(info(**table)).at(POSE)[3:, 3:]
        inside = np.einsum("ni,ij,nj->n", off, np.linalg.inv(known), off) / square < 7.815
        assert inside.mean() == pytest.approx(0.95, abs=0.01)


def test_what_keyframes_scatter_is_added_in_every_axis():
    known = Uncertainty(np.diag(SIGMA**2), ABOUT, 9)
    more = Accuracy(0.002, 0.03, known).at(POSE) - Accuracy(registration=known).at(POSE)
    assert np.allclose(more, np.diag([0.002**2] * 3 + [0.03**2] * 3))


def test_a_maps_accuracy_is_what_its_registration_says():
    table = {
        "sigma_deg": 0.5,
        "sigma_m": 0.02,
        "covariance": np.diag(SIGMA**2).tolist(),
        "covariance_about_m": ABOUT.tolist(),
    }
    found = accuracy(info(**table))
    assert found.sigma_rad == pytest.approx(np.radians(0.5)) and found.sigma_m == 0.02
    assert np.allclose(found.registration.covariance, np.diag(SIGMA**2))
    assert np.allclose(found.registration.centre, ABOUT)
    assert accuracy(info(point_sigma_m=0.01)).sigma_m == 0.01  # of measured places
    assert not accuracy(info()).at(POSE).any()  # of an older program
    assert not accuracy(info("sfm", **table)).at(POSE).any()  # in coordinates that are not a world


@pytest.mark.parametrize(
    ("registration", "word"),
    [
        ({"sigma_m": -0.1}, "sigma_m"),
        ({"sigma_m": float("nan")}, "sigma_m"),
        ({"sigma_deg": "wide"}, "sigma_deg"),
        ({"sigma_deg": [0.1]}, "sigma_deg"),
        ({"point_sigma_m": 10**400}, "point_sigma_m"),
        ({"covariance": [[1.0]]}, "covariance"),
        ({"covariance": np.eye(7).tolist()}, "covariance_about_m"),
        ({"covariance": (-np.eye(7)).tolist(), "covariance_about_m": [0, 0, 0]}, "covariance"),
        (
            {
                "covariance": np.eye(7).tolist(),
                "covariance_about_m": [0, 0, 0],
                "degrees_of_freedom": "eleven",
            },
            "degrees_of_freedom",
        ),
        (
            {"covariance": np.triu(np.ones((7, 7))).tolist(), "covariance_about_m": [0, 0, 0]},
            "covariance",
        ),
        (
            {"covariance": (1e300 * np.eye(7)).tolist(), "covariance_about_m": [0, 0, 0]},
            "covariance",
        ),
    ],
)
def test_what_is_no_accuracy_is_refused_in_a_line(registration, word):
    with pytest.raises(MapError, match=f"map.toml, registration: '{word}'") as caught:
        accuracy(info(**registration))
    assert "\n" not in str(caught.value)
