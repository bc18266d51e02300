"""Every physical effect that planes and boards feel, how it is switched off, and the cases of an error budget."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Effect:
    """What can be switched off.

    Parameters
    ----------
    off : tuple of str
        Overrides of the rig file that switch it off.
    within : str, optional
        The effect without which it does nothing.
    """

    off: tuple[str, ...]
    within: str | None = None


GLASS = "lenses of glass"

EFFECTS: dict[str, Effect] = {
    "shot noise": Effect(("twin.camera.shot_noise=false",)),
    "read noise": Effect(("twin.camera.read_noise_e=0",)),
    "pixels' fixed patterns": Effect(("twin.camera.prnu=0", "twin.camera.dsnu_e=0")),
    "quantisation": Effect(("camera.bits=0",)),
    "ambient light": Effect(("twin.light.ambient=0",)),
    "mirrors' gaps and leaks": Effect(("twin.optics.mirror_fill=1", "twin.optics.off_state=0")),
    "flicker": Effect(("twin.stability.flicker=0",)),
    "vibration": Effect(("twin.stability.vibration_um=0",)),
    "drift of the table": Effect(("twin.stability.table_drift_um=0",)),
    "drift of the paths": Effect(("twin.stability.path_drift_um=0",)),
    "stage: position": Effect(("twin.stage.position_sd_um=0",)),
    "stage: straightness": Effect(("twin.stage.straightness_sd_um=0",)),
    "stage: pitch and roll": Effect(("twin.stage.pitch_roll_sd_urad=0",)),
    "stage: axis": Effect(("twin.stage.axis_sd_deg=0",)),
    "board: print": Effect(("twin.board.print_sd_um=0",)),
    "board: scale": Effect(("twin.board.scale_sd_ppm=0", "twin.board.scale_error_ppm=0")),
    "board: bow": Effect(("twin.board.bow_sd_um=0",)),
    "board: wedge": Effect(("twin.board.wedge_sd_urad=0",)),
    "board: ink": Effect(("twin.board.ink_thickness_um=0",)),
    "camera's diffraction": Effect(("twin.optics.camera_diffraction=false",)),
    "finite aperture": Effect(("twin.optics.finite_aperture=false",)),
    GLASS: Effect(("twin.optics.glass=false",)),
    "colour of the light": Effect(("twin.light.bandwidth_um=0",), GLASS),
    "as built: elements": Effect(("twin.assembly.decentre_um=0", "twin.assembly.tilt_deg=0"), GLASS),
    "as built: focus": Effect(("twin.assembly.image_tilt_deg=0", "twin.assembly.focus_um=0"), GLASS),
    "as built: axes": Effect(("twin.assembly.axis_deg=0", "twin.assembly.pointing_um=0"), GLASS),
}
"""Every effect of planes and boards. The projector's diffraction is none of them: without it the lattice of its mirrors
would be projected."""

ALL, NONE = "everything", "nothing"
REPEATS = 4
"""Runs with everything on, each with noise of its own: how far a figure changes by chance."""


@dataclass(frozen=True)
class Case:
    """One line of the budget.

    Parameters
    ----------
    name : str
        "everything", "everything, run K", "nothing", "all but X" or "X alone".
    off : tuple of str
        Overrides that switch the other effects off.
    run : str
        Whose noise and drifts it has. Cases of the same run draw the same numbers for what is on in both.
    """

    name: str
    off: tuple[str, ...]
    run: str = "budget"


def without(name: str) -> str:
    """The case with every effect but one."""
    return f"all but {name}"


def alone(name: str) -> str:
    """The case with one effect, and the one without which it does nothing."""
    within = EFFECTS[name].within
    return f"{name} alone" if within is None else f"{name} alone, in {within}"


def cases() -> list[Case]:
    """All lines of the budget."""
    lines = [Case(ALL, ())]
    lines += [Case(f"{ALL}, run {k}", (), f"budget {k}") for k in range(2, REPEATS + 1)]
    lines += [Case(NONE, _all_but())]
    lines += [Case(alone(name), _all_but(name, effect.within)) for name, effect in EFFECTS.items()]
    lines += [Case(without(name), effect.off) for name, effect in EFFECTS.items()]
    return lines


def _all_but(*kept: str | None) -> tuple[str, ...]:
    return tuple(setting for name, effect in EFFECTS.items() if name not in kept for setting in effect.off)
