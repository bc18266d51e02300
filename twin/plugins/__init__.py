"""Mitsuba plugins: ``lens_sensor``, ``lens_projector`` and the one-pass ``fringe`` integrator.

Import this package after a variant is set; it registers the three names, which then work in any scene.
"""

import mitsuba as mi

if mi.variant() is None:
    raise ImportError("set a Mitsuba variant before greenough.twin.plugins is imported: mi.set_variant('llvm_ad_mono')")

from .fringe import FringeIntegrator
from .lens_projector import LensProjector
from .lens_sensor import LensSensor

mi.register_sensor("lens_sensor", LensSensor)
mi.register_emitter("lens_projector", LensProjector)
mi.register_integrator("fringe", FringeIntegrator)

__all__ = ["FringeIntegrator", "LensProjector", "LensSensor"]
