import importlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import pytest

from greenough.instrument.command import GROUP, run

INSTRUMENT = EntryPoint("instrument", "greenough.instrument.commands:app", GROUP)

VERBS = """
import typer
from greenough.instrument.errors import InputError
from greenough.instrument.verbs import JsonOption, show

app = typer.Typer()

@app.command()
def fine(as_json: JsonOption = False):
    show({"height_mm": 0.25, "bad": float("nan"), "rows": [{"n": 1, "holds": True}]}, as_json)

@app.command()
def unexpected():
    raise typer.Exit(1)

@app.command()
def refused():
    raise InputError("the coin is too large; give a smaller one")

@app.command()
def interrupted():
    raise KeyboardInterrupt

@app.command()
def buggy():
    raise RuntimeError("a bug")
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], EntryPoint]:
    """Writes a module and returns the entry point of its app."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(module: str, source: str) -> EntryPoint:
        path = tmp_path.joinpath(*module.split(".")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
        importlib.invalidate_caches()
        monkeypatch.delitem(sys.modules, module, raising=False)
        return EntryPoint(module.partition(".")[0], f"{module}:app", GROUP)

    return write


def test_the_exit_code_says_how_it_ended(install, capsys: pytest.CaptureFixture[str]) -> None:
    verbs = install("exit_code_verbs", VERBS)
    for line, code in (("fine", 0), ("unexpected", 1), ("refused", 2), ("interrupted", 130), ("--help", 0)):
        assert run([line], [verbs]) == code, line
    for line in (["no-such-verb"], ["fine", "--no-such-option"], ["fine", "surplus"]):
        assert run(line, [verbs]) == 2, line
    capsys.readouterr()


def test_bad_input_is_one_sentence_on_standard_error(install, capsys: pytest.CaptureFixture[str]) -> None:
    run(["refused"], [install("refusing_verbs", VERBS)])
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "greenough: the coin is too large; give a smaller one\n"


def test_an_interruption_is_one_line(install, capsys: pytest.CaptureFixture[str]) -> None:
    run(["interrupted"], [install("interrupted_verbs", VERBS)])
    assert capsys.readouterr().err.count("\n") == 1


def test_an_interruption_while_collecting_is_one_line(install, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"], [install("interrupting_verbs", "raise KeyboardInterrupt")]) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_a_bug_stays_a_traceback(install) -> None:
    with pytest.raises(RuntimeError, match="a bug"):
        run(["buggy"], [install("buggy_verbs", VERBS)])


def test_json_holds_every_value_and_null_for_what_is_not_finite(install, capsys: pytest.CaptureFixture[str]) -> None:
    run(["fine", "--json"], [install("json_verbs", VERBS)])
    found = json.loads(capsys.readouterr().out)
    assert found == {"height_mm": 0.25, "bad": None, "rows": [{"n": 1, "holds": True}]}


def test_verbs_of_all_packages_stand_side_by_side(install, capsys: pytest.CaptureFixture[str]) -> None:
    one_verb = "import typer\napp = typer.Typer()\n@app.command()\ndef {0}():\n    print('{0} ran')\n"
    sources = [install(f"side_{name}", one_verb.format(name)) for name in ("left", "right")]
    for name in ("left", "right"):
        assert run([name], sources) == 0
        assert capsys.readouterr().out == f"{name} ran\n"


def test_a_package_that_is_not_installed_is_simply_absent(capsys: pytest.CaptureFixture[str]) -> None:
    absent = EntryPoint("twin", "no_such_package.validation.commands:app", GROUP)
    assert run(["check", "--help"], [INSTRUMENT, absent]) == 0
    assert capsys.readouterr().err == ""


def test_a_blocked_twin_is_absent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in [name for name in sys.modules if name.startswith("greenough.twin")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "greenough.twin", None)
    twin = EntryPoint("twin", "greenough.twin.validation.commands:app", GROUP)
    assert run(["check", "--help"], [INSTRUMENT, twin]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("broken_name", "import typer\napp = no_such_name\n", "NameError: name 'no_such_name'"),
        ("broken_import", "import a_module_it_forgot\n", "ModuleNotFoundError: No module named 'a_module_it_forgot'"),
        ("broken_app", "apps = 3\n", "AttributeError"),
        ("broken_syntax", "def (:\n", "SyntaxError"),
    ],
)
def test_a_package_that_fails_costs_its_own_verbs_and_says_why(
    install, capsys: pytest.CaptureFixture[str], module: str, source: str, expected: str
) -> None:
    assert run(["check", "--help"], [install(module, source), INSTRUMENT]) == 0
    printed = capsys.readouterr()
    assert "check" in printed.out
    assert expected in printed.err
    assert printed.err.startswith(f"greenough: the verbs of {module}:app are missing")


def test_a_commands_module_missing_in_an_installed_package_is_an_error_that_is_shown(
    install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("half_package.__init__", "")
    missing = EntryPoint("half", "half_package.commands:app", GROUP)
    assert run(["check", "--help"], [missing, INSTRUMENT]) == 0
    assert "No module named 'half_package.commands'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "allowed"),
    # Typer itself reads what a line names by pydantic.
    [(["--help"], ""), (["no-such-verb"], "pydantic"), (["calibrate", "--help"], "pydantic")],
)
def test_what_computes_nothing_loads_nothing_heavy(line: list[str], allowed: str) -> None:
    script = """
import sys
from importlib.metadata import entry_points
from greenough.instrument.command import run
run(sys.argv[1:], entry_points(group="greenough.commands"))
heavy = "numpy scipy mitsuba drjit cv2 h5py pydantic trimesh igl matplotlib jinja2 rich distributed"
print(*(set(heavy.split()) & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script, *line], check=True, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] in ("", allowed)


def test_every_verb_is_listed_with_a_whole_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    sources = list(entry_points(group=GROUP))
    assert run(["--help"], sources) == 0
    listed = capsys.readouterr().out.partition("Commands:\n")[2].splitlines()
    assert len(listed) >= len(sources) > 0
    assert all(line.endswith(".") and not line.endswith("...") for line in listed), listed


def test_a_kill_cleans_up_like_an_exception(tmp_path: Path) -> None:
    script = """
import sys, time
from importlib.metadata import EntryPoint
import typer
from greenough.instrument import command
from greenough.instrument.files import atomic_path

verbs = type(sys)("killed_verbs")
verbs.app = typer.Typer()
@verbs.app.command()
def write(target: str):
    with atomic_path(target) as path:
        path.write_text("half")
        print("writing", flush=True)
        time.sleep(60)
sys.modules["killed_verbs"] = verbs
command.entry_points = lambda group: [EntryPoint("killed", "killed_verbs:app", group)]
command.main()
"""
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        process = subprocess.Popen(
            [sys.executable, "-c", script, "write", str(tmp_path / "target.h5")],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        with process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"writing\n"
            assert len(list(tmp_path.iterdir())) == 1
            process.send_signal(number)
            assert process.wait() == code
        assert list(tmp_path.iterdir()) == []


def test_the_installed_command_answers() -> None:
    command = Path(sys.executable).parent / "greenough"
    done = subprocess.run([command, "check", "no-such-rig"], capture_output=True, text=True)
    assert done.returncode == 2
    refusal = "greenough: no rig no-such-rig: give a built-in name (paper, twin, wire) or the path of a rig file\n"
    assert refusal in done.stderr


CHOSEN = """
import os
import typer

app = typer.Typer()

@app.command()
def where():
    print(os.environ.get("GREENOUGH_VARIANT"))

@app.command()
def other():
    pass
"""


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "cuda_ad_mono"])
def test_the_variant_is_chosen_for_every_verb_before_it_runs(install, monkeypatch, capsys, variant):
    monkeypatch.setenv("GREENOUGH_VARIANT", "that of the shell")
    assert run(["--variant", variant, "where"], [install("chosen", CHOSEN)]) == 0
    assert capsys.readouterr().out.strip() == variant


def test_a_variant_that_cannot_render_fringes_is_refused_with_those_that_can(install, monkeypatch, capsys):
    monkeypatch.setenv("GREENOUGH_VARIANT", "that of the shell")
    assert run(["--variant", "scalar_rgb", "where"], [install("refused", CHOSEN)]) == 2
    assert "'scalar_rgb' cannot render fringe stacks: use one of cuda_ad_mono, llvm_ad_mono" in capsys.readouterr().err
