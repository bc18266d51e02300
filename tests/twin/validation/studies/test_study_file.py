"""Wrong study files are refused with a sentence that names the field and what is allowed."""

from pathlib import Path

import pytest

from greenough.instrument.errors import InputError
from greenough.twin.validation.studies import builtin_studies, load_study
from greenough.twin.validation.studies.experiments import KINDS, experiment
from greenough.twin.validation.studies.runs import runs_of


def written(path: Path, text: str) -> Path:
    file = path / "mine.toml"
    file.write_text(text)
    return file


START = 'name = "mine"\nkind = "cost"\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('name = "a b"\nkind = "cost"\nseeds = 1', ["name", "text such as", "stage-error"]),
        (START, ["seeds is missing"]),
        (START + "seeds = 0", ["seeds", "count from 1 to 10000", "list"]),
        (START + "seeds = [1, 1]", ["seeds", "different"]),
        (START + "seeds = [-1]", ["seeds", "from 0 to 4294967295"]),
        (START + 'seeds = "many"', ["seeds", "count"]),
        (START + "seeds = true", ["seeds", "count"]),
        ('name = "mine"\nkind = "costs"\nseeds = 1', ["kind", '"cost"', "package.module:function", "costs"]),
        ('name = "mine"\nkind = "os:nothing"\nseeds = 1', ["kind", "os:nothing"]),
        (START + "seeds = 1\ncasse = 1", ["there is no field casse", "nearest", "case"]),
        (START + 'seeds = 1\nsettings = ["camera.rows"]', ["settings[0]", "camera.rows", "such as"]),
        (START + 'seeds = 1\nsettings = ["twin.seed=3"]', ["twin.seed", "seeds"]),
        (START + 'seeds = 1\n[cases]\na = ["twin.seed=3"]', ["twin.seed", "seeds"]),
        (START + "seeds = 1\n[cases]\na = 3", ["cases.a = 3", "list"]),
        (START + "seeds = 1\n[limits]\nstep_um = -1", ["limits.step_um = -1", "from 0"]),
        (START + "seeds = 1\n[limits]\npaper.step_um = true", ["limits.paper.step_um", "number"]),
        (START + "seeds = 1\n[repeats]\nall = 3", ["repeats.all", "as set"]),
        (START + 'seeds = "9 to 3x"', ["seeds", "FIRST to LAST"]),
        (START + 'seeds = "9 to 1²"', ["seeds", "FIRST to LAST"]),
        (START + "seeds = 1\n[instruments]\nall = 3", ["instruments.all", "as set"]),
        (START + 'seeds = 1\n[agree]\ne = ["as set", "all"]', ["agree.e.all", "as set"]),
        (START + 'seeds = 1\n[kinds]\n"as set" = "nothing"', ["kinds", "coverage"]),
        (START + 'seeds = 1\n[repeats]\n"as set" = 1', ["repeats.as set = 1", "from 2"]),
        (START + 'seeds = 1\n[effects]\nx = { off = ["a=0"], within = "y" }', ["effects.x.within", "y"]),
        (START + "seeds = 1\n[effects]\nx = { on = 1 }", ["effects.x.on", "no field"]),
        (START + "seeds = ", ["not valid TOML at line 3"]),
    ],
)
def test_wrong_fields_are_named_with_what_is_allowed(tmp_path, text, words):
    with pytest.raises(InputError) as refusal:
        load_study(written(tmp_path, text))
    sentence = str(refusal.value)
    assert not sentence.endswith(".")
    assert "\n" not in sentence
    assert "mine.toml" in sentence
    assert [word for word in words if word not in sentence] == [], sentence


def test_an_unknown_study_is_told_the_known_ones():
    with pytest.raises(InputError, match=r"no study nothing: give a built-in name \(ablation"):
        load_study("nothing")


def test_a_count_and_a_list_of_seeds(tmp_path):
    assert load_study(written(tmp_path, START + "seeds = 4")).seeds == (1, 2, 3, 4)
    assert load_study(written(tmp_path, START + "seeds = [7, 0]")).seeds == (7, 0)
    last = load_study(written(tmp_path, START + 'seeds = "4294967294 to 4294967295"'))
    assert last.seeds == (4294967294, 4294967295)


def test_a_kind_that_fails_to_import_is_no_wrong_field(tmp_path, monkeypatch):
    (tmp_path / "broken_kind.py").write_text("import nothing_of_that_name")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="nothing_of_that_name"):
        load_study(written(tmp_path, 'name = "mine"\nkind = "broken_kind:measure"\nseeds = 1'))


@pytest.mark.slow
@pytest.mark.parametrize("name", builtin_studies())
def test_built_in_studies_can_be_run(name):
    """Rig and twin take the settings of every case."""
    study = load_study(name)
    assert study.name == name  # runs are named by it, and with it their noise
    planned = sum(
        study.repeats.get(case, 1) * len(study.instruments.get(case, study.seeds)) for case in study.all_cases
    )
    assert len({(run.case, run.seed, run.repeat) for run in runs_of(study)}) == planned


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_its_function(kind):
    assert callable(experiment(kind))


def test_settings_that_a_case_must_not_have_are_refused_before_the_first_run(tmp_path):
    text = START + 'seeds = 2\n[cases]\ngood = []\n"small" = ["twin.optics.na=0.01"]'
    with pytest.raises(InputError, match=r"case small of study mine: .*na is that of the glass"):
        runs_of(load_study(written(tmp_path, text)))


def test_rigs_without_truth_are_refused(tmp_path):
    rig = tmp_path / "lab.toml"
    builtin = Path(__file__).parents[4] / "instrument" / "rigs" / "twin.toml"
    rig.write_text(builtin.read_text().replace("greenough.twin:open_rig", "laboratory:open_rig"))
    with pytest.raises(InputError, match="only a twin"):
        runs_of(load_study(written(tmp_path, f"{START}seeds = 1\nrig = '{rig}'")))
