"""How a camera moves while its rows are exposed one after another: a constant twist."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from ground_station.arrays import F64


class RowMotion:
    """From the camera at the frame's time to the camera at each of N rows' times.

    `row_s` (N,) are the rows' times after the frame's, `twist` (6,) the camera's: a row's camera is
    at wTc·exp(twist·row_s).
    """

    def __init__(self, row_s: F64, twist: F64) -> None:
        self.row_s, self.ad = row_s, gtsam.Pose3.adjointMap(twist)
        self.hat = self.ad[:3, :3]
        self.square = self.hat @ self.hat
        rate = math.sqrt(float(twist[:3] @ twist[:3]))
        # Rodrigues' formula of exp(−twist·row_s), with the row's time in its coefficients.
        coefficients = np.empty((3, len(row_s)))
        if rate > 1e-6:
            angle = rate * row_s
            np.divide(np.sin(angle), -rate, out=coefficients[0])
            half = np.sin(0.5 * angle)
            np.multiply(2 / rate**2, half * half, out=coefficients[1])
            np.add(row_s, coefficients[0], out=coefficients[2])
            coefficients[2] *= -1 / rate**2
        else:
            np.negative(row_s, out=coefficients[0])
            np.multiply(0.5 * row_s, row_s, out=coefficients[1])
            np.multiply(-row_s / 3, coefficients[1], out=coefficients[2])
        self.first, self.second = coefficients[0], coefficients[1]
        drift = np.empty((3, 3))
        drift[:, 0] = twist[3:]
        np.matmul(self.hat, drift[:, 0], out=drift[:, 1])
        np.matmul(self.square, drift[:, 0], out=drift[:, 2])
        self.drift = drift @ coefficients

    def forward(self, points: F64) -> F64:
        """Points (3, N) of the frame's camera in those of the rows: exp(−twist·row_s)·p."""
        result = self.hat @ points
        result *= self.first
        turned = self.square @ points
        turned *= self.second
        result += turned
        result += points
        result += self.drift
        return result

    def turned_back(self, directions: F64) -> F64:
        """Directions (A, 3, N) of the rows' cameras in the frame's."""
        result = self.square @ directions
        result *= self.second
        turned = self.hat @ directions
        turned *= self.first
        result -= turned
        result += directions
        return result

    def jacobian(self, J: F64) -> F64:
        """Columns (6, 2, N) for steps of the rows' poses to (12, 2, N) for pose and twist.

        Right tangents, to first order in the motion between the frame's time and the row's.
        """
        bracket = (self.ad.T @ J.reshape(6, -1)).reshape(J.shape)
        bracket *= self.row_s
        result = np.empty((12, *J.shape[1:]))
        np.subtract(J, bracket, out=result[:6])
        bracket *= -0.5
        bracket += J
        np.multiply(bracket, self.row_s, out=result[6:])
        return result
