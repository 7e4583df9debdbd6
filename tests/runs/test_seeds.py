"""Several seeds trained at once, as one program: the same runs as alone, each in its folder."""

import csv

import numpy as np
import pytest

from fmpjax import cli, runs
from fmpjax.checkpoint import Checkpoints
from fmpjax.errors import UserError
from tests.helpers import TINY, settings, tiny

pytestmark = pytest.mark.slow


def rows(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def group(tmp_path_factory):
    """Seeds 3 and 4, begun by the command line and stopped by their time budget after the first chunk."""
    folder = tmp_path_factory.mktemp("seeds") / "group"
    cli.main(
        ["train", "--preset", "smoke", *settings(TINY), "--seed", "3", "--seeds", "2", "--run", str(folder),
         "--minutes", "0.0001", "--no-pictures"]
    )  # fmt: skip
    return folder


def test_each_seed_is_a_run_of_its_own(group):
    for seed in (3, 4):
        run = runs.Run.open(group / f"seed{seed}")
        assert run.config == tiny(seed=seed)
        assert Checkpoints(run.folder).latest() == 2
        assert (run.folder / "evaluation.json").exists()
        assert not {"frames.png", "curves.png", "policy.mp4"} & {path.name for path in run.folder.iterdir()}


def test_seeds_at_once_are_the_seeds_alone(group, tmp_path):
    """To rounding: batched products are summed in another order, which contacts make larger within the chunk."""
    alone = runs.Run.create(tmp_path / "alone", tiny(seed=4))
    runs.train(alone, minutes=1e-6)
    one, other, neighbor = rows(alone.folder)[0], rows(group / "seed4")[0], rows(group / "seed3")[0]
    close = [k for k in one if k.startswith(("train/", "fit/", "ppo/")) and one[k]]
    assert len(close) > 20
    for name in close:
        assert float(other[name]) == pytest.approx(float(one[name]), rel=2e-2, abs=2e-3), name
    assert abs(float(one["fit/epsilon"]) / float(neighbor["fit/epsilon"]) - 1) > 1e-4
    trainer = alone.trainer()
    states = [Checkpoints(f).restore(trainer.shapes()) for f in (alone.folder, group / "seed4", group / "seed3")]
    np.testing.assert_array_equal(states[0].prior.bank, states[1].prior.bank)
    np.testing.assert_array_equal(states[0].key, states[1].key)
    assert np.any(np.asarray(states[0].prior.bank) != np.asarray(states[2].prior.bank))


def test_runs_that_differ_in_more_are_refused(tmp_path):
    one = runs.Run.create(tmp_path / "a", tiny(seed=0))
    other = runs.Run.create(tmp_path / "b", tiny(seed=1, **{"ppo.discount": 0.5}))
    with pytest.raises(
        UserError, match=r"b has ppo.discount 0.5 and run .*a 0.97: runs that train together may differ only in"
    ):
        runs.train(one, other)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "--seeds is 0: expected at least 1"),
        (["--resume", "--run", "GROUP", "--seeds", "3"], "has 2 seeds: it cannot continue with 3"),
        (["--resume", "--run", "GROUP", "--seed", "9"], "seed9 is not a run folder"),
    ],
)
def test_bad_seeds(group, capsys, arguments, message):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["train", *(word.replace("GROUP", str(group)) for word in arguments)])
    assert exit_info.value.code == 2
    assert message in capsys.readouterr().err
