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
        return self.values.std(ddof=1) / np.sqrt(len(self.values))

    def __sub__(self, other):
        """Of values with the same seeds: what is random in both goes away."""
        return Estimate(self.values - (other.values if isinstance(other, Estimate) else other))

    def __str__(self):
        return f"{self.mean:.5f} +- {self.error:.5f}"


class Pictures:
    """Renders of a scene of which parameters move from where they are, along flat arrays by their keys."""

    def __init__(self, scene, along, spp, seeds=6):
        self.scene, self.parameters, self.spp, self.seeds = scene, mi.traverse(scene), spp, range(seeds)
        self.along = {key: upload(mi.Float, np.ravel(values)) for key, values in along.items()}
        self.start = {key: dr.opaque(self.parameters[key]) for key in along}

    def mean(self, step, seed):
        for key, value in self.start.items():
            self.parameters[key] = value + step * self.along[key]
        self.parameters.update()
        return dr.mean(mi.render(self.scene, self.parameters, spp=self.spp, seed=seed), axis=None)

    def differences(self, h):
        ends = [[self.mean(mi.Float(side * h), seed).array[0] for side in (1, -1)] for seed in self.seeds]
        return Estimate(np.array([(a - b) / (2 * h) for a, b in ends]))

    def forward(self):
        values = []
        for seed in self.seeds:
            step = mi.Float(0)
            dr.enable_grad(step)
            value = self.mean(step, seed)
            dr.forward(step)
            values.append(dr.grad(value).array[0])
        return Estimate(np.array(values, dtype=np.float64))

    def gradients(self):
        """``(seeds, n)`` gradients of the mean by each of the parameters, by key."""
        by_seed = []
        for seed in self.seeds:
            dr.enable_grad(self.start)
            dr.backward(self.mean(mi.Float(0), seed))
            by_seed.append({key: np.array(dr.grad(value), dtype=np.float64) for key, value in self.start.items()})
            dr.disable_grad(self.start)
        return {key: np.array([values[key] for values in by_seed]) for key in self.start}

    def reverse(self):
        return sum_along(self.gradients(), self.along)


def sum_along(gradients, along):
    return Estimate(sum(gradients[key] @ np.ravel(along[key]).astype(np.float64) for key in along))
