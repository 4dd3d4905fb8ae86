"""The integrator `foreground`: pictures with alpha, in which meshes that emit light are seen, and no environment is."""

from __future__ import annotations

from typing import Any

from ..variants import Variant

FOREGROUND = "foreground"


def make_foreground(variant: Variant) -> type:
    """Make the integrator's class of a variant of Mitsuba."""
    is_scalar = variant.Float is float

    class Foreground(variant.SamplingIntegrator):
        """Uses the integrator ``shown`` where a ray of the camera first hits a mesh that emits light.

        Elsewhere it uses ``hidden``, whose parameter ``hide_emitters`` would hide such meshes as well.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self._hidden, self._shown = props["hidden"], props["shown"]

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            """The radiance of a ray, whether it hits anything, and no AOVs."""
            first = scene.ray_intersect_preliminary(ray, active=active)
            if is_scalar:
                shines = first.is_valid() and first.shape.is_emitter() and first.shape.is_mesh()
                radiance, is_valid, _ = (self._shown if shines else self._hidden).sample(scene, sampler, ray, medium)
                return radiance, is_valid or shines, []
            shines = active & first.is_valid() & first.shape.is_emitter() & first.shape.is_mesh()
            radiance, is_valid, _ = self._hidden.sample(scene, sampler, ray, medium, active & ~shines)
            glow, _, _ = self._shown.sample(scene, sampler, ray, medium, shines)
            return radiance + glow, is_valid | shines, []

        def to_string(self) -> str:
            return f"Foreground[\n  hidden = {self._hidden},\n  shown = {self._shown}\n]"

    return Foreground
