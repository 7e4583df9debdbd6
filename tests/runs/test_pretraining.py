"""What SMP learns before its policy: trained once for a demonstration and settings, kept, and given to every run."""

import csv
import dataclasses
import json
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from fmpjax import cli, machine, motion, priors
from fmpjax.errors import UserError
from fmpjax.logs import Progress
from fmpjax.runs import Run, pretraining
from fmpjax.runs.session import Session
from fmpjax.trainer import Trainer
from tests.helpers import tiny

SMP = {"method": "smp", "smp.iterations": 30, "smp.batch": 8}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """The user's cache folder, an empty one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "fmpjax" / "pretrained"


@pytest.fixture(scope="module")
def trainer(walk):
    return Trainer(tiny(**SMP), walk)


def leaves(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def changed(trainer, **values):
    """A trainer that is another one only for `identity`."""
    other = object.__new__(Trainer)
    other.__dict__ = trainer.__dict__ | values
    return other


def test_what_is_learned_is_kept_with_its_course(trainer, cache, monkeypatch, capsys):
    folder = pretraining.folder_of(trainer)
    monkeypatch.setattr(pretraining, "ROWS", 10)
    learned = pretraining.pretrain(trainer, folder, Progress())
    assert folder.parent == cache and [path.name for path in cache.glob("[!.]*")] == [folder.name]
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    assert [int(row["iteration"]) for row in rows] == list(range(3, 31, 3))
    losses = [float(row["pretraining/loss"]) for row in rows]
    assert losses[-1] < losses[0] and all(float(row["pretraining/skipped"]) == 0 for row in rows)
    assert (folder / "curves.png").stat().st_size > 5_000 and list((folder / "tensorboard").iterdir())
    told = json.loads((folder / "settings.json").read_text())
    assert told["settings"]["smp.network"] == "small" and told["motions"] == [["walk", 1.0]]
    said = capsys.readouterr().out
    assert "pretraining smp on the demonstration, 30 iterations: smp.network=small" in said

    monkeypatch.setattr(pretraining, "_train", None)  # not to be called
    again = pretraining.pretrain(trainer, folder, Progress())
    for one, other in zip(leaves(learned), leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert f"smp is pretrained on the demonstration already, in {folder}" in capsys.readouterr().out
    with pytest.raises(TypeError):
        pretraining.pretrain(trainer, folder, Progress(), again=True)


def test_who_begins_meanwhile_waits_and_reads(trainer, cache, monkeypatch, capsys):
    """Two cells that start together train once."""
    folder, train, calls = pretraining.folder_of(trainer), pretraining._train, []
    waits = threading.Event()

    def slow(*arguments):
        calls.append(arguments)
        waits.wait(60.0)
        return train(*arguments)

    class Told(Progress):
        def note(self, line):
            super().note(line)
            if "waiting for it" in line:
                waits.set()

    monkeypatch.setattr(pretraining, "_train", slow)
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(pretraining.pretrain, trainer, folder, Told()) for _ in range(2)]
        one, other = (leaves(each.result()) for each in both)
    assert len(calls) == 1 and waits.is_set()
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    said = capsys.readouterr().out
    assert "another process pretrains smp" in said and "pretrained on the demonstration already" in said


def test_a_file_that_is_broken_is_made_again(trainer, capsys):
    folder = pretraining.folder_of(trainer)
    for content in (b"PK\x03\x04 broken", b""):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "learned.npz").write_bytes(content)
        pretraining.pretrain(trainer, folder, Progress())
        assert f"{folder} cannot be read: pretraining again" in capsys.readouterr().out
        assert (folder / "learned.npz").stat().st_size > 1_000


def test_the_same_demonstration_and_settings_are_the_same_whatever_the_run(trainer, tmp_path):
    """A run reads its clip from its own folder, and has a seed and a policy of its own."""
    run = Run.create(tmp_path / "run", tiny(**SMP, seed=7, **{"env.reset": "fixed", "smp.scale": 3.0}))
    assert pretraining.identity(run.trainer()) == pretraining.identity(trainer)


def test_what_the_model_depends_on_has_another_name(trainer, walk):
    own = pretraining.identity(trainer)
    shifted = dataclasses.replace(walk, qpos=walk.qpos + np.float32(1e-3))
    library = motion.MotionLibrary((shifted,), (1.0,))
    features = dataclasses.replace(trainer.config.features, axes="heading")
    longer = trainer.prior.pretraining._replace(settings=trainer.prior.pretraining.settings | {"smp.iterations": 31})
    others = [
        changed(trainer, library=library),
        changed(trainer, config=dataclasses.replace(trainer.config, features=features)),
        changed(trainer, prior=trainer.prior._replace(pretraining=longer)),
    ]
    names = {own, *map(pretraining.identity, others)}
    assert len(names) == 4


def test_runs_begin_pretrained_and_have_the_course(trainer, tmp_path):
    """Two seeds get one network each of their own, and a state that is pretrained stays as it is."""
    folders = [tmp_path / "a", tmp_path / "b"]
    states = [trainer.init(seed) for seed in (0, 1)]
    made = pretraining.pretrained(trainer, states, folders, Progress())
    for state in made:
        assert bool(trainer.prior.pretraining.finished(state.prior))
        for one, other in zip(leaves(state.prior.average), leaves(made[0].prior.average), strict=True):
            np.testing.assert_array_equal(one, other)
    buffers = [leaf.unsafe_buffer_pointer() for state in made for leaf in jax.tree.leaves(state.prior)]
    assert len(set(buffers)) == len(buffers)
    for folder in folders:
        assert {path.name for path in (folder / "pretraining").iterdir()} == {
            "metrics.csv", "tensorboard", "curves.png", "settings.json",
        }  # fmt: skip
    same = pretraining.pretrained(trainer, made, [tmp_path / "c"], Progress())
    assert same[0] is made[0] and not (tmp_path / "c").exists()


def test_without_a_cache_folder_the_run_keeps_it(trainer, tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "cache_folder", lambda *names: None)
    (tmp_path / "a").mkdir()
    pretraining.pretrained(trainer, [trainer.init()], [tmp_path / "a"], Progress())
    assert (tmp_path / "a" / "pretraining" / "learned.npz").exists()


def test_numbers_that_are_not_finite_are_not_kept(trainer, cache, monkeypatch):
    broken = trainer.prior.pretraining._replace(learned=lambda state: (state.average, state.loss * np.nan))
    bad = changed(trainer, prior=trainer.prior._replace(pretraining=broken))
    with pytest.raises(UserError, match=r"the pretraining of smp gave numbers that are not finite: expected a smaller"):
        pretraining.pretrain(bad, pretraining.folder_of(bad), Progress())
    assert not list(cache.glob("[!.]*"))


def test_a_session_pretrains_before_it_compiles(tmp_path, monkeypatch):
    run = Run.create(tmp_path / "run", tiny(**SMP))
    session = Session([run])
    session.pretrain(Progress())
    assert int(session.states[0].prior.iteration) == 30 and (run.folder / "pretraining" / "curves.png").exists()
    # A method without pretraining does nothing.
    other = Session([Run.create(tmp_path / "other", tiny())])
    before = other.states[0]
    other.pretrain(Progress())
    assert other.states[0] is before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["amp"], "method 'amp' has no pretraining: expected smp"),
        (["gan"], "unknown method 'gan': expected one of fmp, "),
        (["smp", "--set", "smp"], "--set 'smp': expected section.field=value"),
    ],
)
def test_what_cannot_be_pretrained_is_refused(arguments, sentence, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["pretrain", *arguments])
    assert stop.value.code == 2 and capsys.readouterr().err.startswith(f"fmpjax: {sentence}")


def test_the_command_pretrains_for_the_runs_that_follow(trainer, cache, capsys):
    settings = {key: value for key, value in SMP.items() if key != "method"}
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    cli.main(["pretrain", "smp", "--preset", "smoke", *words])
    (folder,) = cache.glob("[!.]*")
    assert folder == pretraining.folder_of(trainer)
    assert f"in the cache: {folder / 'curves.png'}" in capsys.readouterr().out


def test_every_pretrained_method_says_so(trainer):
    assert trainer.prior.pretraining is not None
    priors.check_pretrained("smp")
