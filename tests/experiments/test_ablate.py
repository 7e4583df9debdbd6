"""The matched comparison: plans, cells that go on after a kill, tables from their runs."""

import json
import math
import re
import signal
import subprocess
import sys
import time

import pytest

from fmpjax import config as configuration
from fmpjax import priors
from fmpjax.errors import UserError
from fmpjax.experiments import ablate
from fmpjax.experiments.common import cells, table
from tests import helpers

TINY = helpers.TINY | {"transitions": 8 * 8 * 4, "evaluations": (0.5, 1.0)}  # two chunks


def toml(settings):
    return "\n".join(f'"{key}" = {json.dumps(value)}' for key, value in settings.items())


def specification(path, text):
    path.write_text(text)
    return cells.read_specification(path)


# --- plans -----------------------------------------------------------------------------------------------------------


def test_plan_is_every_method_of_the_paper_reset_and_seed():
    planned = cells.plan(cells.Specification(preset="smoke", seeds=(0, 7)))
    assert len(planned) == 6 * 2 * 2
    assert len({cell.name for cell in planned}) == len(planned)
    assert {(c.config.method, c.config.env.reset, c.config.seed) for c in planned} == {
        (m, r, s) for m in priors.PAPER for r in ("dataset", "fixed") for s in (0, 7)
    }
    # All of a seed come before the next one, so that half of a plan is a comparison, too.
    assert [c.config.seed for c in planned] == [0] * 12 + [7] * 12
    # Nothing else differs between two cells.
    a, b = (configuration.flatten(c.config) for c in planned[::12])
    assert {k for k in a if a[k] != b[k]} == {"seed"}


def test_plan_from_a_file(tmp_path):
    spec = specification(
        tmp_path / "plan.toml",
        'preset = "smoke"\nmethods = ["fmp"]\nresets = ["dataset"]\nseeds = [0, 1]\n'
        '[settings]\n"ppo.discount" = 0.9\n[variants.short]\n"env.first_cap" = 32\n[variants.long]\n',
    )
    planned = cells.plan(spec)
    assert [c.name for c in planned] == [
        "fmp-dataset-short/seed0", "fmp-dataset-long/seed0", "fmp-dataset-short/seed1", "fmp-dataset-long/seed1",
    ]  # fmt: skip
    assert [c.config.env.first_cap for c in planned] == [32, 64, 32, 64]
    assert {c.config.ppo.discount for c in planned} == {0.9}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sedes = [1]", "plan.toml: unknown key 'sedes', expected one of preset, motion"),
        ('seeds = "0"', "plan.toml: seeds is '0', expected a list of whole numbers"),
        ("seeds = [true]", "expected a list of whole numbers"),
        ("seeds = []", "expected a list of whole numbers"),
        ("methods = [1]", "expected a list of names"),
        ("transitions = 1.5", "transitions is 1.5, expected a whole number"),
        ("pictures = 0", "pictures is 0, expected true or false"),
        ("variants = 3", "expected tables of"),
        ("preset = ", "plan.toml is not valid TOML"),
    ],
)
def test_bad_specification(tmp_path, text, message):
    with pytest.raises(UserError, match=re.escape(message)):
        specification(tmp_path / "plan.toml", text)


def test_missing_specification_and_unknown_names(tmp_path):
    with pytest.raises(UserError, match="cannot read .*none.toml: No such file"):
        cells.read_specification(tmp_path / "none.toml")
    with pytest.raises(UserError, match="unknown method 'gan'"):
        cells.plan(cells.Specification(methods=("gan",)))
    with pytest.raises(UserError, match="setting env.reset is 'random': expected one of dataset, fixed"):
        cells.plan(cells.Specification(resets=("random",)))
    with pytest.raises(UserError, match=r"unknown setting 'ppo.gamma'"):
        cells.plan(cells.Specification(settings={"ppo.gamma": 0.9}))
    with pytest.raises(UserError, match="the plan names fmp-dataset/seed0 2 times"):
        cells.plan(cells.Specification(methods=("fmp",), seeds=(0, 0)))
    with pytest.raises(UserError, match="the plan has no cells"):
        cells.plan(cells.Specification(methods=()))


def test_errors_exit_with_code_two(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_info:
        ablate.cli(["--out", str(tmp_path), "--methods", "gan"])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err == f"fmpjax: unknown method 'gan': expected one of {', '.join(priors.METHODS)}\n"
    file, folder = tmp_path / "file", tmp_path / "out"
    file.write_text("")
    (folder / "fmp-dataset" / "seed0").mkdir(parents=True)
    (folder / "fmp-dataset" / "seed0" / "config.json").write_text('{"seed": ')
    for where, message in ((file, "cannot be written: expected a folder"), (folder, "is not valid JSON")):
        with pytest.raises(SystemExit):
            ablate.cli(["--out", str(where), "--preset", "smoke"])
        assert message in capsys.readouterr().err
    with pytest.raises(UserError, match="--workers is 0: expected at least 1"):
        cells.run(cells.plan(cells.Specification(preset="smoke", methods=("fmp",))), tmp_path, workers=0)


# --- cells -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ablated(tmp_path_factory):
    """A tiny cell, and what `ablate` wrote of it. What becomes of one that is killed stands in test_benchmark.py."""
    folder = tmp_path_factory.mktemp("ablate")
    (folder / "plan.toml").write_text(
        'preset = "smoke"\nmethods = ["fmp"]\nresets = ["dataset"]\n[settings]\n' + toml(TINY)
    )
    ablate.cli(["--spec", str(folder / "plan.toml"), "--out", str(folder / "out")])
    return folder, cells.plan(cells.read_specification(folder / "plan.toml"))


@pytest.mark.slow
def test_sigterm_ends_the_cells_too(tmp_path):
    out, plan = tmp_path / "out", tmp_path / "plan.toml"
    endless = TINY | {"transitions": 64 * 20_000, "evaluations": (1.0,)}
    plan.write_text('preset = "smoke"\nmethods = ["fmp"]\n[settings]\n' + toml(endless))
    process = subprocess.Popen(
        [sys.executable, "-m", "fmpjax.experiments.ablate", "--spec", str(plan), "--out", str(out)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    log, until = out / "fmp-dataset" / "seed0.log", time.monotonic() + 300
    while not (log.exists() and log.read_text()) and time.monotonic() < until:
        time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=300) == 143
    # The cell was waited for: it writes no more.
    size = log.stat().st_size
    time.sleep(2)
    assert log.stat().st_size == size and not (out / "fmp-fixed").exists()


@pytest.mark.slow
def test_ablate_writes_tables_and_curves(ablated):
    folder, planned = ablated
    names = ("results.csv", "results.json", "table.md", "table.tex", "curves.png", "curves.pdf")
    assert all((folder / "out" / name).stat().st_size > 0 for name in names)
    assert all(cells.finished(cell, folder / "out") for cell in planned)
    results = json.loads((folder / "out" / "results.json").read_text())
    assert [(e["cell"], e["transitions"]) for e in results["evaluations"]] == [
        ("fmp-dataset/seed0", 128), ("fmp-dataset/seed0", 256),
    ]  # fmt: skip
    assert results["provenance"]["python"]
    made = json.loads((folder / "out" / "fmp-dataset/seed0" / "provenance.json").read_text())
    assert results["runs"]["fmp-dataset/seed0"]["commit"] == made["commit"]
    assert str(folder) not in (folder / "out" / "results.json").read_text()
    rows = table.evaluations(planned[0], folder / "out")
    saved = json.loads((folder / "out" / "fmp-dataset/seed0" / "config.json").read_text())
    assert (rows[-1].method, rows[-1].reset, rows[-1].seed) == ("fmp", "dataset", saved["seed"])


@pytest.mark.slow
def test_results_of_another_configuration_are_refused(ablated):
    folder, _ = ablated
    other = cells.plan(cells.Specification(preset="smoke", methods=("fmp",), settings=TINY | {"ppo.discount": 0.5}))
    with pytest.raises(
        UserError, match=r"fmp-dataset/seed0 holds a run with ppo.discount 0.97, not 0.5: name another --out"
    ):
        cells.run(other, folder / "out")


@pytest.mark.slow
def test_a_cell_that_fails_is_named_after_the_others_ran(tmp_path):
    changes = TINY | {"motion": str(tmp_path / "none.npz")}
    bad = cells.plan(cells.Specification(preset="smoke", methods=("fmp",), resets=("fixed",), settings=changes))
    with pytest.raises(UserError, match=r"1 of the cells failed: see .*fmp-fixed/seed0.log \(fmp-fixed/seed0\)"):
        cells.run(bad, tmp_path / "out")
    assert "none.npz" in (tmp_path / "out" / "fmp-fixed/seed0.log").read_text()


# --- tables ----------------------------------------------------------------------------------------------------------


def row(method, seed, speed, reset="dataset", variant="", **further):
    figures = {"mean_length": 490.0, "falls": 5.0, "late_speed": speed, "excursion": 1.0, "amplitude_mae": 9.0,
               "discrepancy": 0.2}  # fmt: skip
    return table.Row(f"{method}-{reset}-{seed}", method, reset, variant, seed, 1000, 60.0, figures | further)


def test_interval_is_student_s():
    """Of 0.6, 0.7, 0.8: mean 0.7, deviation 0.1, t(2) = 4.3027, half width 4.3027 * 0.1 / sqrt 3 = 0.2484."""
    mean, half = table.interval([0.6, 0.7, 0.8, math.nan])
    assert mean == pytest.approx(0.7)
    assert half == pytest.approx(0.24841, rel=1e-4)
    assert math.isnan(table.interval([0.6])[1])
    assert math.isnan(table.interval([math.nan])[0])


def test_table_has_the_paper_beside_ours():
    lines = table.markdown([row("fmp", 0, 0.6), row("fmp", 1, 0.7), row("amp", 0, math.nan)]).splitlines()
    assert len(lines) == 2 + 4
    assert lines[2].startswith("| dataset | FMP | 2 | 490.0 ± 0.0 | 5.0 ± 0.0 | 0.650 ± 0.635 |")
    assert lines[3].startswith(
        "| dataset | FMP, the paper's | 1 | 500.0 | 0.0 (n = 1024) | 0.727 (n = 64) | 1.119 | 9.95 | 0.159 |"
    )
    assert lines[4].startswith("| dataset | AMP | 1 | 490.0 | 5.0 | – |")
    # Of whom a figure is the mean, where not of all.
    lines = table.markdown([row("fmp", i, v) for i, v in enumerate((0.88, math.nan, 0.9))]).splitlines()
    assert "| 0.890 ± 0.127 (2 of 3) |" in lines[2]
    assert len({line.count("|") for line in lines}) == 1
    latex = table.latex([row("fmp", 0, 0.6)])
    assert latex.count(r"\\") == 3
    assert r"0.600" in latex
    assert "%" not in latex.replace(r"\%", "")


def test_variants_have_rows_of_their_own():
    lines = table.markdown([row("fmp", 0, 0.6, variant="short"), row("fmp", 0, 0.7, variant="long")]).splitlines()
    assert [line.split("|")[2].strip() for line in lines[2:]] == ["FMP, short", "FMP, long"]


def test_falls_stand_at_every_size_of_noise_with_their_episodes():
    """An old evaluation beside a new one: it has no falls at a size, and no figure in the paper's features."""
    sized = {"noise": 1e-3, "episodes": 256.0, "late_n": 64.0, "falls_at_0": 0.0, "episodes_at_0": 1.0,
             "falls_at_0.01": 50.0, "episodes_at_0.01": 86.0}  # fmt: skip
    new = [row("fmp", seed, 0.6, "fixed", **sized) for seed in (0, 1)]
    old = row("amp", 0, 0.5, "fixed", sinkhorn=0.1, episodes=256.0, late_n=256.0)
    del old.figures["discrepancy"]
    headings, body = table.lines([*new, old])
    found = [dict(zip(headings, line, strict=True)) for line in body]
    assert headings[3:8] == ["mean steps", "falls, %", "at 0 rad, %", "at 0.01 rad, %", "speed, m/s"]
    assert found[0]["falls, %"] == "5.0 ± 0.0 (n = 512)" and found[0]["at 0 rad, %"] == "0.0 ± 0.0 (n = 2)"
    assert found[0]["at 0.01 rad, %"] == "50.0 ± 0.0 (n = 172)" and found[0]["speed, m/s"] == "0.600 ± 0.000 (n = 128)"
    assert found[1]["falls, %"] == "12.6 (n = 1024)" and found[1]["at 0 rad, %"] == "–"
    assert found[2]["at 0.01 rad, %"] == found[2]["Sinkhorn"] == "–"
    assert found[2]["speed, m/s"] == "0.500 (1 start per seed)"
    assert table._cell([new[0], old], table.COLUMNS[1]).endswith(" (n = 257)")
    now, before = table.notes([*new, old])
    assert "all other figures of starts with 0.001 rad (fixed reset)" in now and "do not compare" in before
    assert len(table.notes(new)) == len(table.notes([old])) == 1
    assert "at 0.01 rad" not in table.markdown([old])


def test_runs_of_earlier_versions_are_read(tmp_path):
    """Falls become per cent of the episodes at their size; cells that an old file lacks or left empty are blank."""
    (cell,) = cells.plan(cells.Specification(preset="smoke", methods=("fmp",), resets=("fixed",)))
    run = tmp_path / cell.name
    run.mkdir(parents=True)

    def read(text):
        (run / "metrics.csv").write_text("iteration,transitions,seconds,eval/quality,eval/episodes,eval/falls" + text)
        return table.evaluations(cell, tmp_path)

    (old,) = read(",eval/sinkhorn\n1,10,2.0,0.5,8,2,0.07\n")
    assert old.figure("falls") == 25.0 and old.figures["sinkhorn"] == 0.07 and math.isnan(old.figure("discrepancy"))
    before, new = read(",eval/falls_at_0.01,eval/episodes_at_0.01\n1,10,2.0,0.5,8,2,,\n2,20,4.0,0.5,8,2,3,4\n")
    assert math.isnan(before.figure("falls_at_0.01")) and new.figure("falls_at_0.01") == 75.0
    provenance = {"commit": "c", "uncommitted_changes": False, "date": "d", "device": "e"}
    (run / "provenance.json").write_text(json.dumps(provenance))
    table.write([cell], tmp_path)
    assert "| 75.0 (n = 4) |" in (tmp_path / "table.md").read_text()
    assert r"75.0 (n = 4) &" in (tmp_path / "table.tex").read_text()
    results = json.loads((tmp_path / "results.json").read_text())["evaluations"]
    assert results[0]["falls_at_0.01"] is None and results[1]["falls_at_0.01"] == 75.0
