"""From light to grey values: the camera's noise chain by EMVA 1288."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from greenough.instrument.packets import packed
from greenough.instrument.rigfile import CameraSection

from .randomness import exposure_key, instrument_rng
from .renderer import dr, mi
from .settings import CameraSettings

Byte: Any = dr.uint8_array_t(mi.Float)


@dataclass(frozen=True)
class Sensor:
    """One image sensor as it was made: its data sheet, its true noise, and the fixed patterns of its pixels."""

    section: CameraSection
    settings: CameraSettings
    gain: mi.Float  # (pixels,) relative responsivity, mean 1
    offset_e: mi.Float  # (pixels,) dark signal in electrons, mean 0

    @property
    def full_scale_dn(self) -> float:
        """Grey value at which frames clip; float frames do not."""
        return self.section.full_scale_dn if self.section.bits else float("inf")


def build_sensor(section: CameraSection, settings: CameraSettings, seed: int) -> Sensor:
    """Draw the pixels of one sensor."""
    rng = instrument_rng(seed, "sensor")
    pixels = section.rows * section.cols
    gain = 1 + settings.prnu * rng.standard_normal(pixels)
    offset = settings.dsnu_e * rng.standard_normal(pixels)
    return Sensor(
        section, settings, *(mi.Float(packed(values.astype(np.float32), aligned=True)) for values in (gain, offset))
    )


def expose(electrons: list[mi.Float], sensor: Sensor, seed: int, run: str, first_serial: int) -> np.ndarray:
    """Read out one frame for each of the N images of mean ``electrons``, (rows * cols,) each.

    Returns
    -------
    (N, rows, cols) uint8, uint16, or float32 where the camera does not quantise.
    """
    section = sensor.section
    dtype = {0: np.float32, 8: np.uint8, 16: np.uint16}[section.bits]
    # All kernels are launched before the first result is waited for; whole grey values of 8 bits travel as such.
    kind = Byte if section.bits == 8 else mi.Float
    frames = []
    for k, mean in enumerate(electrons):
        frames.append(kind(_read_out(mean, sensor, exposure_key(seed, run, first_serial + k))))
        dr.eval(frames[-1])
    stack = np.empty((len(electrons), section.rows, section.cols), dtype)
    for k, frame in enumerate(frames):
        stack[k] = frame.numpy().reshape(section.rows, section.cols)
    return stack


def _read_out(mean: mi.Float, sensor: Sensor, key: int) -> mi.Float:
    section, settings = sensor.section, sensor.settings
    rng = dr.rng(seed=dr.opaque(mi.UInt64, key))
    # Both are drawn whatever is on, so that switching one noise off leaves the other as it was.
    shot, read = (rng.normal(mi.Float, dr.width(sensor.gain)) for _ in range(2))
    electrons = mean * sensor.gain
    if settings.shot_noise:
        electrons = poisson(electrons, shot)
    electrons += sensor.offset_e
    if settings.read_noise_e > 0:
        electrons += settings.read_noise_e * read
    grey = section.black_level_dn + electrons / section.noise.electrons_per_dn
    if section.bits:
        grey = dr.clip(dr.round(grey), 0, section.full_scale_dn)
    return grey


def displaced(image: mi.Float, shape: tuple[int, int], shift: np.ndarray) -> mi.Float:
    """An ``image``, (rows * cols,), that has moved by ``shift`` (columns, rows), a small fraction of a pixel.

    To first order in the shift, by slopes of fourth order in the pixel: differences of the neighbours one and two
    pixels away, extrapolated. What diffraction leaves at the pixels' own scale moves a little less.
    """
    if not shift.any():
        return image
    rows, cols = shape
    pixel = dr.arange(mi.UInt32, rows * cols)

    def slope(place: mi.UInt32, length: int, stride: int) -> mi.Float:
        def difference(most: int) -> mi.Float:
            # The same on both sides, so that near the rim the order falls but the place stays, the rim itself excepted.
            reach = dr.minimum(most, dr.maximum(dr.minimum(place, length - 1 - place), 1))
            before, after = dr.maximum(place, reach) - reach, dr.minimum(place + reach, length - 1)
            high = dr.gather(mi.Float, image, pixel + (after - place) * stride)
            low = dr.gather(mi.Float, image, pixel - (place - before) * stride)
            return (high - low) / mi.Float(after - before)

        return (4 * difference(1) - difference(2)) / 3

    # Opaque, so that one kernel serves all shifts.
    across, down = (dr.opaque(mi.Float, float(s)) for s in shift)
    return image - across * slope(pixel % cols, cols, 1) - down * slope(pixel // cols, rows, cols)


def poisson(mean: mi.Float, normal: mi.Float) -> mi.Float:
    """Photon counts from standard normal numbers by the Cornish-Fisher expansion of the Poisson quantile.

    Mean and variance are within 0.02 of Poisson's from 0.3 electrons upwards; in the dark 0.05 electrons remain.
    """
    root = dr.sqrt(dr.maximum(mean - 1 / 12, 0))  # rounding adds 1/12 to the variance
    second = (dr.square(normal) - 1) / 6
    third = normal * (1 - dr.square(normal)) / (72 * dr.maximum(root, 2))
    return dr.maximum(dr.round(mean + root * normal + second + third), 0)
