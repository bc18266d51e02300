"""A study on one machine: every run once, none lost, none dropped, and the sums are those of the runs."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.twin.validation.studies import load_study
from greenough.twin.validation.studies.runs import execute, kept, runs_of
from greenough.twin.validation.studies.study import here, run_study


def command(*words: str) -> int:
    return run(["study", *words], entry_points(group=GROUP))


def results(folder: Path) -> dict[str, dict]:
    return {path.name: json.loads(path.read_text()) for path in folder.glob("seed-*.json")}


def test_an_interrupted_study_goes_on_and_does_no_run_twice(study_file, visits, tmp_path):
    study = load_study(study_file("interrupted"))
    runs = runs_of(study)

    def interrupted(todo):
        for k, done in enumerate(here(todo)):
            if k == 4:
                raise KeyboardInterrupt
            yield done

    with pytest.raises(KeyboardInterrupt):
        run_study(study, runs, tmp_path / "out", interrupted)
    assert len(results(tmp_path / "out")) == 4
    assert not (tmp_path / "out" / "summary.json").exists()
    before = results(tmp_path / "out")
    advanced: list[float] = []
    run_study(study, runs, tmp_path / "out", advance=advanced.append)
    assert sum(advanced) == 2
    after = results(tmp_path / "out")
    assert len(after) == 6
    assert {name: after[name] for name in before} == before
    assert len(visits("interrupted")) == 6 + 1  # the one that was cut off before it was kept


@pytest.mark.slow
def test_a_killed_study_keeps_its_finished_runs(study_file, laboratory, tmp_path):
    path, out = study_file("killed", seeds="20"), tmp_path / "out"
    hold = laboratory / "hold"  # it cannot come to its end before the kill
    hold.touch()
    words = [sys.executable, "-c", "from greenough.instrument.command import main; main()"]
    environment = os.environ | {"PYTHONPATH": str(laboratory)}
    process = subprocess.Popen([*words, "study", str(path), "--out", str(out), "--json"], env=environment)
    while len(list(out.glob("seed-*.json"))) < 3:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    hold.unlink()
    runs = runs_of(load_study(path))
    done = [outcome for each in runs if (outcome := kept(out, each))]
    assert 3 <= len(done) < len(runs)
    assert len(done) == len(results(out))


def test_each_result_tells_how_it_came_about(study_file, tmp_path):
    study = load_study(study_file("told", seeds="[7, 9]"))
    run_study(study, runs_of(study, ["camera.bits=16"]), tmp_path)
    found = results(tmp_path).values()
    assert sorted((each["case"], each["seed"]) for each in found) == [("1", 7), ("1", 9), ("2", 7), ("2", 9)]
    for each in found:
        assert each["overrides"] == [
            "camera.bits=16",
            f"twin.stage.position_sd_um={each['case']}",
            f"twin.seed={each['seed']}",
        ]
        assert each["seconds"] >= 0.05
        assert {"python", "greenough", "mitsuba", "numpy"} <= set(each["versions"])
        assert len(each["settings_sha256"]) == 64
        assert each["figures"][0]["lost_um"] is None


def test_only_what_a_change_concerns_is_done_again_and_the_old_is_kept(study_file, visits, tmp_path):
    path = study_file("changed")
    run_study(load_study(path), runs_of(load_study(path)), tmp_path)
    path.write_text(path.read_text().replace("sd_um=2", "sd_um=3"))
    old = results(tmp_path)
    assert len(visits("changed")) == 6
    run_study(load_study(path), runs_of(load_study(path)), tmp_path)
    assert [visit.seed for visit in visits("changed")[6:]] == [1, 2, 3]
    assert results(tmp_path).items() >= old.items()
    path.write_text(path.read_text().replace("seeds = 3", "seeds = 5").replace("sd_um=3", "sd_um=2"))
    run_study(load_study(path), runs_of(load_study(path)), tmp_path)
    assert sorted({visit.seed for visit in visits("changed")[9:]}) == [4, 5]
    run_study(load_study(path), runs_of(load_study(path), ["camera.bits=16"]), tmp_path)
    assert len(visits("changed")) == 9 + 4 + 10


def test_what_the_summary_says_is_computed_from_the_runs(study_file, tmp_path):
    study = load_study(study_file("summed", seeds="[1, 2, 3, 6, 7]"))
    runs = runs_of(study)
    summary = run_study(study, runs, tmp_path)
    heights = np.array([execute(each).figures[1]["height_um"] for each in runs if each.case == "2"])
    (row,) = [s for s in summary.statistics if (s.case, s.line, s.figure) == ("2", "b", "height_um")]
    assert (row.n, row.missing) == (5, 0)
    assert row.mean == pytest.approx(heights.mean())
    assert row.sd == pytest.approx(heights.std(ddof=1))
    assert row.rms == pytest.approx(np.sqrt((heights**2).mean()))
    assert row.p95 == pytest.approx(np.quantile(abs(heights), 0.95))
    assert row.max == pytest.approx(abs(heights).max())
    (lost,) = [s for s in summary.statistics if (s.case, s.figure) == ("2", "lost_um")]
    assert (lost.n, lost.missing) == (0, 5)
    document = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert document["study"]["seeds"] == [1, 2, 3, 6, 7]
    assert {each["file"] for each in document["runs"]} == set(results(tmp_path))


def test_a_failed_run_is_kept_counted_and_named(study_file, visits, tmp_path, capsys):
    path = study_file("failed", seeds="[3, 4]", sections="[limits]\nheight_um = 100")
    for _ in range(2):
        assert command(str(path), "--out", str(tmp_path), "--json") == 1
        printed = json.loads(capsys.readouterr().out)
        rows = {row["name"]: row for row in printed["rows"]}
        assert rows["failed runs"]["value"] == 2
        assert rows["failed runs"]["holds"] is False
        assert rows["1, a, height_um, rms"]["holds"] is False  # one instrument has none
        assert rows["1, a, height_um, rms"]["value"] < 100
        assert {each["failure"] for each in printed["failures"]} == {"the board was not found"}
        assert {each["missing"] for each in printed["statistics"] if each["figure"] == "height_um"} == {1}
    assert len(visits("failed")) == 4


def test_limits_hold_or_the_command_exits_with_one(study_file, tmp_path, capsys):
    sections = "[limits]\nheight_um = 100\nb.height_um = 1e-9"
    path = study_file("limited", seeds="[1, 2]", sections=sections)
    assert command(str(path), "--out", str(tmp_path / "a"), "--json") == 1
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert set(rows["failed runs"]) == {"name", "value", "unit", "peer", "ratio", "limit", "holds"}
    assert [rows[f"{case}, {line}, height_um, rms"]["holds"] for case in "12" for line in "ab"] == [True, False] * 2
    assert rows["1, a, height_um, rms"]["unit"] == "µm"
    path.write_text(path.read_text().replace("1e-9", "100"))
    assert command(str(path), "--out", str(tmp_path / "a"), "--json") == 0
    capsys.readouterr()
    path.write_text(path.read_text() + "\nc.height_um = 100\nheigth_um = 100")
    assert command(str(path), "--out", str(tmp_path / "a"), "--json") == 1
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {row["name"] for row in rows if row["holds"] is False} == {"c.height_um, rms", "heigth_um, rms"}


def test_rates_are_judged_line_by_line(study_file, tmp_path, capsys, laboratory):
    (laboratory / "coin.py").write_text("def measure(*arguments):\n    return [{'side': 'x', 'hit': 1.0}]")
    path = study_file("rated", seeds="20", sections="[rates]\nhit = 0.5\nmiss = 0.5")
    text = path.read_text().replace("heights:", "coin:").replace('"2" = ["twin.stage.position_sd_um=2"]', "")
    path.write_text(text)
    assert command(str(path), "--out", str(tmp_path), "--json") == 1
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert (rows["x, hit, rate"]["value"], rows["x, hit, rate"]["holds"]) == (1, False)
    assert rows["x, hit, rate"]["peer"] == "0.2 to 0.8"  # 3 or fewer of 20 have a chance of 0.13 %, 4 of 0.6 %
    assert rows["miss, rate"]["holds"] is False


@pytest.mark.slow
def test_cases_may_have_experiments_and_instruments_of_their_own_and_must_then_agree(
    study_file, tmp_path, capsys, laboratory
):
    """Two experiments that draw from one distribution, and one that draws from another."""
    draw = "def measure(rig, overrides, run, advance):\n    seed = int(overrides[-1].split('=')[1])\n"
    for name, shift in (("one", 0), ("other", 0), ("third", 3)):
        line = (
            f"    return [{{'side': 'x', 'e': np.random.default_rng([seed, {len(name)}]).normal({shift}), 'hit': 1.0}}]"
        )
        (laboratory / f"{name}.py").write_text("import numpy as np\n" + draw + line)
    sections = (
        '[kinds]\n"2" = "{}:measure"\n[instruments]\n"2" = "11 to 50"\n[agree]\ne = ["1", "2"]\n[rates]\nhit = 0.95'
    )
    for second, holds in (("other", True), ("third", False)):
        path = study_file(f"pair-{second}", seeds="10", sections=sections.format(second))
        path.write_text(path.read_text().replace("heights:", "one:"))
        assert command(str(path), "--out", str(tmp_path / second), "--json") == (0 if holds else 1)
        found = json.loads(capsys.readouterr().out)["rows"]
        rows = {row["name"]: row for row in found}
        assert rows["x, e, agreement of 1 and 2, p"]["holds"] is holds
        assert rows["x, hit, rate"]["peer"].endswith("to 1")  # of 50 draws together
        summary = json.loads((tmp_path / second / "summary.json").read_text())
        assert sorted((run["case"], run["seed"]) for run in summary["runs"]) == [
            *(("1", seed) for seed in range(1, 11)),
            *(("2", seed) for seed in range(11, 51)),
        ]


def test_tables_have_a_row_for_each_case(study_file, tmp_path, capsys):
    path = study_file("read", 'x = "stage, µm"', 'figures = ["height_um"]')
    assert command(str(path), "--out", str(tmp_path)) == 0
    lines = capsys.readouterr().out.splitlines()
    top = lines.index("height_um, a:")
    assert lines[top + 1].split("  ")[1] == "stage, µm"
    assert [line.split()[0] for line in lines[top + 2 : top + 4]] == ["1", "2"]
    assert not any("lost_um" in line for line in lines)


def test_cases_of_one_repeat_share_their_noise_and_repeats_do_not(study_file, visits, tmp_path):
    study = load_study(study_file("noise", seeds="[1]", sections='[repeats]\n"2" = 3'))
    runs = runs_of(study)
    assert [(each.case, each.repeat) for each in runs] == [("1", 1), ("2", 1), ("2", 2), ("2", 3)]
    summary = run_study(study, runs, tmp_path)
    a, b = (execute(each).figures[0]["height_um"] for each in runs[:2])
    assert b == pytest.approx(2 * a)
    assert len({visit.run for visit in visits("noise")}) == 3
    assert {s.case: s.n for s in summary.statistics if s.figure == "height_um"} == {"1": 1, "2": 3}


def test_cases_with_the_same_settings_are_run_once(study_file, visits, tmp_path):
    study = load_study(study_file("twice", seeds="[1]", sections='again = ["twin.stage.position_sd_um=2"]'))
    summary = run_study(study, runs_of(study), tmp_path)
    assert len(visits("twice")) == 2
    assert {s.case for s in summary.statistics} == {"1", "2", "again"}


def test_a_damaged_result_is_refused_with_its_name(study_file, tmp_path):
    study = load_study(study_file("damaged", seeds="[1]"))
    run_study(study, runs_of(study), tmp_path)
    path = next(tmp_path.glob("seed-*.json"))
    path.write_text(path.read_text()[:100])
    with pytest.raises(InputError, match=f"{path.name} is damaged .*remove it"):
        run_study(study, runs_of(study), tmp_path)


def test_a_program_error_is_no_result(study_file, laboratory, tmp_path):
    (laboratory / "wrong.py").write_text("def measure(*arguments):\n    return 1 / 0")
    path = study_file("wrong")
    path.write_text(path.read_text().replace("heights:", "wrong:"))
    study = load_study(path)
    with pytest.raises(ZeroDivisionError):
        run_study(study, runs_of(study), tmp_path)
    assert results(tmp_path) == {}


def test_a_rig_that_reads_otherwise_where_it_is_run_is_refused(study_file, tmp_path):
    rig = tmp_path / "mine.toml"
    rig.write_text((Path(__file__).parents[4] / "instrument" / "rigs" / "twin.toml").read_text())
    study = load_study(study_file("elsewhere", f"rig = {json.dumps(str(rig))}"))
    (first, *_) = runs_of(study)
    rig.write_text(rig.read_text().replace("cols = 1280", "cols = 1270"))
    with pytest.raises(InputError, match="other settings"):
        execute(first)
