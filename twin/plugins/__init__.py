"""Mitsuba plugins: ``lens_sensor``, ``lens_projector`` and the one-pass ``fringe`` integrator.

Importing this package registers the three names, which then work in any scene of the present variant.
"""

from ..renderer import mi
from .fringe import FringeIntegrator
from .lens_projector import LensProjector
from .lens_sensor import LensSensor

mi.register_sensor("lens_sensor", LensSensor)
mi.register_emitter("lens_projector", LensProjector)
mi.register_integrator("fringe", FringeIntegrator)

__all__ = ["FringeIntegrator", "LensProjector", "LensSensor"]
