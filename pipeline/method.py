"""The names of the calibration methods."""

from typing import Literal

Method = Literal["paper", "bundle", "stage-free", "triangulation"]
