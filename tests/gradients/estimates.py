"""Derivatives of a picture's mean as estimates with standard errors, from renders with several seeds."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.device_arrays import upload

# Standard errors of means of six that are allowed; seeds are fixed.
ERRORS = 4
# A standard error beside the value, or beside what scaling changes: else agreement would mean nothing.
MEANS_SOMETHING = 0.03


@dataclass(frozen=True)
class Estimate:
    """One value for each seed."""

    values: np.ndarray

    @property
    def mean(self):
        return self.values.mean()

    @property
    def error(self):
        """Standard error of the mean."""
        return self.values.std(ddof=1) / np.sqrt(len(self.values))

    def __sub__(self, other):
        """Of values with the same seeds: what is random in both goes away."""
        return Estimate(self.values - (other.values if isinstance(other, Estimate) else other))

    def __str__(self):
        return f"{self.mean:.5f} +- {self.error:.5f}"


class Pictures:
    """Renders of a scene whose parameters move: ``start`` has their values, ``along`` how they change with the step."""

    def __init__(self, scene, start, along, spp, seeds=6):
        self.scene, self.parameters = scene, mi.traverse(scene)
        self.start, self.along = ({k: upload(mi.Float, v) for k, v in named.items()} for named in (start, along))
        self.spp, self.seeds = spp, range(seeds)

    def mean(self, step, seed):
        for key, value in self.start.items():
            self.parameters[key] = value + step * self.along[key]
        self.parameters.update()
        return dr.mean(mi.render(self.scene, self.parameters, spp=self.spp, seed=seed), axis=None)

    def differences(self, h):
        """Central differences with the same random numbers."""
        ends = [[self.mean(mi.Float(side * h), seed).array[0] for side in (1, -1)] for seed in self.seeds]
        return Estimate(np.array([(a - b) / (2 * h) for a, b in ends]))

    def derivatives(self, mode):
        values = []
        for seed in self.seeds:
            step = mi.Float(0)
            dr.enable_grad(step)
            value = self.mean(step, seed)
            if mode == "forward":
                dr.forward(step)
                values.append(dr.grad(value).array[0])
            else:
                dr.backward(value)
                values.append(dr.grad(step)[0])
        return Estimate(np.array(values, dtype=np.float64))


def gradients(scene, key, spp, seeds=6, kept=()):
    """``(seeds, n, 3)`` gradients of the mean by flat points, one for each seed.

    Parameters that are ``kept`` are assigned as well: Mitsuba's own meshes make new normals when only positions are.
    """
    parameters = mi.traverse(scene)
    start, by_seed = mi.Float(parameters[key]), []
    # Copies: what is the same array is no assignment.
    others = {name: dr.opaque(parameters[name]) for name in kept}
    for seed in range(seeds):
        points = mi.Float(start)
        dr.enable_grad(points)
        parameters[key] = points
        for name, values in others.items():
            parameters[name] = dr.opaque(values)
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, spp=spp, seed=seed), axis=None))
        by_seed.append(np.array(dr.grad(points), dtype=np.float64).reshape(-1, 3))
    parameters[key] = start
    parameters.update()
    return np.array(by_seed)


def along(by_seed, direction):
    """Estimate of the derivative along a direction."""
    return Estimate((by_seed * direction).sum(axis=(1, 2)))
