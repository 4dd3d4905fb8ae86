"""Cones of directions that contain all tangents, or all normals, of parts of patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..schemes.domain import FloatArray

# Directions whose sine is below this are parallel.
PARALLEL = 1e-9


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """``(.., t)`` products of vectors ``(.., 3, t)``."""
    found: FloatArray = a[..., 0, :] * b[..., 0, :]
    found += a[..., 1, :] * b[..., 1, :]
    found += a[..., 2, :] * b[..., 2, :]
    return found


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``(.., 3, t)`` cross products of vectors ``(.., 3, t)``."""
    found = np.empty(np.broadcast_shapes(a.shape, b.shape), dtype=np.result_type(a, b))
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        np.subtract(a[..., i, :] * b[..., j, :], a[..., j, :] * b[..., i, :], out=found[..., axis, :])
    return found


@dataclass(frozen=True, eq=False)
class TangentCone:
    """Directions that contain all derivatives by a parameter of some patches, or of each part of these."""

    axis: FloatArray  # (.., 3, t) float: unit vectors; zero where there is none
    sine: FloatArray  # (.., t) float: of half the angle of the cone; one where derivatives may have any direction
    shortest: FloatArray  # (.., t) float: least extent of a derivative along the axis

    @classmethod
    def of(cls, derivative: FloatArray) -> TangentCone:
        """Cones of Bernstein coefficients ``(b, .., 3, t)``."""
        total = derivative.sum(axis=0)
        length = np.sqrt(dot(total, total))
        axis = total / np.where(length > 0, length, 1)[..., None, :]
        along, squared = dot(derivative, axis), dot(derivative, derivative)
        cosine = (along / np.sqrt(np.where(squared > 0, squared, 1))).min(axis=0)
        sine = np.where(cosine > 0, np.sqrt(np.maximum(0, 1 - cosine**2)), 1)
        return cls(axis, sine, along.min(axis=0))


@dataclass(frozen=True, eq=False)
class NormalCone:
    """Directions that contain all normals of some patches, or of each part of these."""

    axis: FloatArray  # (.., 3, t) float: unit vectors; zero where there is none
    sine: FloatArray  # (.., t) float: of half the angle of the cone; one where normals may have any direction

    @classmethod
    def of(cls, u: TangentCone, v: TangentCone) -> NormalCone:
        """Cones of the normals to tangents along u and v [Sederberg and Meyers 1988]."""
        normal = cross(u.axis, v.axis)
        sine, cosine = np.sqrt(dot(normal, normal)), np.abs(dot(u.axis, v.axis))
        safe = np.maximum(sine, PARALLEL)
        of_both = np.sqrt(u.sine**2 + 2 * u.sine * v.sine * cosine + v.sine**2) / safe
        exists = (sine > PARALLEL) & (u.sine < 1) & (v.sine < 1) & (of_both < 1)
        return cls(np.where(sine > PARALLEL, 1 / safe, 0)[..., None, :] * normal, np.where(exists, of_both, 1))

    @classmethod
    def of_any(cls, count: int) -> NormalCone:
        """Cones of ``count`` patches with unknown normals."""
        return cls(np.zeros((3, count)), np.ones(count))

    def around(self, axis: FloatArray) -> NormalCone:
        """Cones about other axes ``(3, t)`` that contain these."""
        angle = np.arccos(np.clip(dot(self.axis, axis), -1, 1)) + np.arcsin(np.clip(self.sine, 0, 1))
        return NormalCone(axis, np.where((self.sine < 1) & (angle < np.pi / 2), np.sin(angle), 1))

    def along(self, vectors: FloatArray, longest: FloatArray) -> FloatArray:
        """``(.., t)`` largest extent of vectors ``(b, .., 3, t)`` along a normal, with their largest squared length."""
        return np.abs(dot(vectors, self.axis)).max(axis=0) + self.sine * np.sqrt(longest)
