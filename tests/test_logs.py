"""W&B and trackio, by stand-ins for their modules: both get the rows of the CSV file."""

import csv
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from fmpjax import cli, logs
from fmpjax.errors import UserError
from fmpjax.logs import MetricsLog, Mirror


@pytest.fixture(params=logs.LOGGERS)
def logger(request, monkeypatch):
    """A stand-in: what its run was opened with, and what it was given."""
    given = SimpleNamespace(name=request.param, opened=[], rows=[], ended=0, fault=None)

    class Opened:
        def log(self, figures, step):
            if given.fault:
                raise given.fault
            given.rows.append((step, figures))

        def finish(self):
            given.ended += 1

    def init(project, name=None, **options):
        given.opened.append({"project": project, "name": name, **options})
        return Opened()

    module = ModuleType(request.param)
    module.__spec__, module.init = ModuleSpec(request.param, None), init
    monkeypatch.setitem(sys.modules, request.param, module)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return given


def test_a_logger_gets_the_rows_of_the_csv_file(logger, tmp_path):
    run = tmp_path / "walk"
    run.mkdir()
    logs.check_logger(logger.name)
    log = MetricsLog(run, ["a", "eval/b"], mirror=Mirror(logger.name, run, {"ppo.discount": 0.99}))
    log.write(2, 128, 1.234, {"a": 1 / 3, "eval/b": float("nan")})
    log.write(4, 256, 2.5, {"a": 2e-9, "eval/b": 7.0})
    log.close()
    with (run / "metrics.csv").open() as file:
        rows = [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]
    assert logger.rows == [(128, rows[0]), (256, rows[1])]
    assert set(rows[0]) == {"iteration", "transitions", "seconds", "a"}
    assert logger.ended == 1
    (opened,) = logger.opened
    assert opened["project"] == "fmpjax" and opened["name"].startswith("walk") and opened["resume"] == "allow"
    assert opened["config"] == {"ppo.discount": 0.99}
    assert opened.get("mode") == ("offline" if logger.name == "wandb" else None)
    # A resumed run continues there, another folder of that name does not.
    (tmp_path / "in" / "walk").mkdir(parents=True)
    Mirror(logger.name, run, {})
    Mirror(logger.name, tmp_path / "in" / "walk", {})
    key = "id" if logger.name == "wandb" else "name"
    first, again, other = (each[key] for each in logger.opened)
    assert first == again != other


def test_a_loggers_fault_does_not_end_a_training(logger, tmp_path, capsys):
    log = MetricsLog(tmp_path, ["a"], mirror=Mirror(logger.name, tmp_path, {}))
    logger.fault = RuntimeError("no space")
    for iteration in (1, 2):
        log.write(iteration, 64 * iteration, 1.0, {"a": 1.0})
    log.close()
    assert capsys.readouterr().err == f"{logger.name} failed (no space): no more rows are logged there\n"
    assert len(MetricsLog.read(tmp_path / "metrics.csv")) == 2


def test_a_logger_that_cannot_start_is_one_sentence(logger, tmp_path, monkeypatch):
    def init(*_, **__):
        raise OSError("no key")

    monkeypatch.setattr(sys.modules[logger.name], "init", init)
    with pytest.raises(UserError, match=rf"logger '{logger.name}' cannot start \(no key\): expected"):
        Mirror(logger.name, tmp_path, {})


def test_an_unknown_or_missing_logger_is_one_sentence(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for name, sentence in (
        ("mlflow", "logger is 'mlflow': expected one of wandb, trackio"),
        ("trackio", "logger 'trackio' needs the package trackio, which is missing: pip install 'fmpjax[loggers]'"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["train", "--preset", "smoke", "--logger", name, "--run", str(tmp_path / "run")])
        assert stop.value.code == 2 and capsys.readouterr().err == f"fmpjax: {sentence}\n"
    assert not Path(tmp_path / "run").exists()
