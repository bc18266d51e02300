"""The phase of N shifted fringe frames, as exactly as shot noise allows.

The N-step formula of the paper's eq. 2 takes all frames alike. But bright frames scatter more than dark ones, and so
the noise of neighbouring harmonics is correlated. With

    X_k = 2/N Σ_n I_n exp(-2π i k n / N)

the fringes I_n = A + B cos(φ + 2π n / N) have X_1 = B exp(iφ) and X_2 = X_3 = ... = 0: what those hold is noise, from
which that of X_1 can be told in part. A grey value's variance being a + b I above black, and V = a + b A, the turned
harmonics x_k = X_k exp(-ikφ) have in both their real and their imaginary parts the variance 2V/N, neighbours the
covariance 2V/N g with g = b B / (2 V), and others none. (The sums over n behind this vanish while the harmonics do not
alias, that is while 2k + 1 < N.) The combination x_1 - h_2 x_2 - h_3 x_3 - ... of least variance follows by
elimination from the last harmonic K to the first,

    z_K = X_K,   t_K = 0,   t_k = g / (1 - g t_(k+1)),   z_k = X_k - t_k exp(-iφ) z_(k+1),

and z_1 = B exp(iφ) has the variance (1 - g t_1) 2V/N across and along. The same without divisions, by the continuants

    P_0 = P_1 = 1,   P_(j+1) = P_j - g² P_(j-1),   y_K = X_K,   y_k = P_(K-k) X_k - g exp(-iφ) y_(k+1),

where t_(K-j) = g P_(j-1) / P_j, is z_1 = y_1 / P_(K-1) with 1 - g t_1 = P_K / P_(K-1). With K large t_k tends to
ρ = (1 - sqrt(1 - 4g²)) / (2g); these are the weights of frames by their inverse variance, whose fit has the variance
2V / (N (1 + ρ²)), the bound of Cramér and Rao. With K harmonics this is exceeded by the factor
(1 - ρ^(2K+2)) / (1 - ρ^(2K)), and K = 1 is eq. 2 (`phase_bound` has the bound of grey values as they are, counted,
read and rounded). The angle φ by which the harmonics are turned is that of eq. 2;
its error counts only together with the noise of the higher ones.

Harmonics in the fringes themselves, from a response that is not linear, are in phase with them: the j-th is
B_j cos(j (φ + 2π n / N)). It reaches the real part of x_j only, and so B but not φ, unless it aliases. N frames show it
as the (N - j)-th, so that all of order j < N - K are without effect; eq. 2 is safe up to N - 2. Four and five frames
leave no room for a second harmonic, and are decoded by eq. 2.

The weights lean on this: where a nonlinear projector is imaged by a lens whose point spread is not symmetric, harmonics
come out of phase, and the share t_1 of what is so in the second one goes into φ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, pi, sin

from .jit import Complex2f, Float, dr

_LEAST = 1e-20  # DN²; keeps black pixels of perfect frames from dividing zero by zero
_ZERO = 1e-12  # what sine and cosine leave of their zeros


@dataclass(frozen=True)
class Phasor:
    """Fringes of one set, B exp(iφ).

    Parameters
    ----------
    phase : Float
        Wrapped phase φ, rad.
    modulation : Float
        Modulation B, DN.
    variance : Float
        Variance of φ, and of ln B, rad².
    """

    phase: Float
    modulation: Float
    variance: Float


def highest_harmonic(steps: int) -> int:
    """The K for N ``steps``: as many harmonics as do not alias into each other, 2K + 1 < N, but at least the first."""
    return max(1, steps // 2 - 1)


def estimate_phasor(grey: Sequence[Float], variance: Float, per_dn: Float) -> Phasor:
    """Phase and modulation of one set of frames, each pixel by itself.

    Parameters
    ----------
    grey : one Float per step
        Grey values I_n, DN above any level.
    variance : Float
        V, the variance of a grey value as bright as the background, DN².
    per_dn : Float
        b, by how much it grows with the grey value, DN.
    """
    steps = len(grey)
    harmonics = _harmonics(grey, highest_harmonic(steps))
    amplitude = dr.sqrt(_squared(harmonics[0]))
    # g exp(-iφ). B does not exceed V / b, but noise may lift it: then g is 0.5.
    turn = dr.conj(harmonics[0]) * (per_dn / dr.maximum(2 * dr.maximum(variance, per_dn * amplitude), _LEAST))
    g_squared = _squared(turn)

    before, continuant, multiple = 1.0, 1.0, harmonics[-1]  # P_(j-1), P_j, y_(K-j+1)
    for harmonic in reversed(harmonics[:-1]):
        multiple = continuant * harmonic - turn * multiple
        before, continuant = continuant, continuant - g_squared * before
    squared = _squared(multiple)
    return Phasor(
        phase=dr.atan2(multiple.imag, multiple.real),
        modulation=dr.sqrt(squared) / before,
        variance=2 / steps * before * continuant * variance / squared,
    )


def _squared(value: Complex2f) -> Float:
    """|value|², here of grey values, whose squares do not overflow as `drjit.hypot` fears."""
    return dr.fma(value.real, value.real, value.imag * value.imag)


def _harmonics(grey: Sequence[Float], highest: int) -> list[Complex2f]:
    """X_1 to X_highest, DN.

    The frames n and N - n have one cosine and opposite sines: their sums make the real parts, their differences the
    imaginary ones.
    """
    steps = len(grey)
    half = range(steps // 2 + 1)
    sums = [grey[n] + grey[-n] if 0 < 2 * n < steps else grey[n] for n in half]
    differences = [grey[n] - grey[-n] for n in half]
    harmonics = []
    for order in range(1, highest + 1):
        angles = [2 * pi * order * n / steps for n in half]
        real = _weighted_sum(sums, [2 / steps * cos(angle) for angle in angles])
        imaginary = _weighted_sum(differences, [-2 / steps * sin(angle) for angle in angles])
        harmonics.append(Complex2f(real, imaginary))
    return harmonics


def _weighted_sum(values: Sequence[Float], weights: Sequence[float]) -> Float:
    total = Float(0)
    for value, weight in zip(values, weights, strict=True):
        if abs(weight) > _ZERO:
            total = dr.fma(value, weight, total)
    return total
