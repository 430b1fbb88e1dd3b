"""The promises, R1 to R17: what each says, its target, and the experiment that tries it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path


@dataclass(frozen=True)
class Setting:
    """How an experiment shall be run.

    :param quick: whether to take the short form: the same kinds of trials, fewer of them
    :param folder: an empty folder of its own, removed afterwards
    :param seed: of every random choice of the experiment
    :param note: prints a line on progress
    """

    quick: bool
    folder: Path
    seed: int
    note: Callable[[str], None] = lambda line: None


@dataclass(frozen=True)
class Outcome:
    """What came out of an experiment.

    :param held: trials in which the promise was kept
    :param tried: all trials
    :param said: what the trials were and what was seen, a few words behind the two numbers
    :param failures: a line for each trial, or kind of trial, in which it was not kept
    :param stock: what Stable-Baselines3, PettingZoo or SuperSuit did in the same run, a few words;
        empty where there is nothing to compare with
    :param skipped: why it could not be tried here, as a missing extra; empty if it was
    """

    held: int
    tried: int
    said: str
    failures: tuple[str, ...] = ()
    stock: str = ""
    skipped: str = ""

    @property
    def kept(self) -> bool:
        """Whether the promise was kept in every trial, and there was one."""
        return self.tried > 0 and self.held == self.tried and not self.failures


@dataclass(frozen=True)
class Promise:
    """One promise.

    :param name: ``R1`` to ``R17``
    :param text: what is promised
    :param target: of the full form
    :param experiment: ``module:function`` below ``sb3_roles.prove``; it takes a :class:`Setting`
        and returns an :class:`Outcome`
    :param has_quick: whether there is a short form
    """

    name: str
    text: str
    target: str
    experiment: str
    has_quick: bool = True

    def prove(self, setting: Setting) -> Outcome:
        """Run the experiment.

        :param setting: how
        """
        module, _, function = self.experiment.partition(":")
        outcome: Outcome = getattr(import_module(f"sb3_roles.prove.{module}"), function)(setting)
        return outcome


PROMISES = {
    promise.name: promise
    for promise in (
        Promise("R1", "kill -9 at random instants of one run, restarted each time: the final "
            "weights, optimizer and logs are those of a run without", "20/20", "kills:restarts"),
        Promise("R2", "a resumed run equals a straight one, at every cut, for 1 and 2 threads, "
            "float32 and bfloat16, every algorithm", "all", "resumption:cuts"),
        Promise("R3", "kill -9 in a tight loop of saves: the newest checkpoint or the one before "
            "loads", "200/200", "kills:saves"),
        Promise("R4", "the disk fills up while saving: earlier checkpoints are whole, one line",
            "20/20", "full_disk:offsets"),
        Promise("R5", "corrupted checkpoints are refused with one line, wrong weights never load",
            "1000/1000", "corruption:damaged"),
        Promise("R6", "hostile checkpoints: no code runs, memory stays bounded, exit code 2",
            "all of at least 12 kinds", "hostile:hostile"),
        Promise("R7", "no pickle, eval or unsafe YAML on any load path of the source", "0 hits",
            "source_gate:hits"),
        Promise("R8", "malformed configurations and command lines: exit code 2, one line that "
            "names key and range, under a second", "60/60", "malformed:commands"),
        Promise("R9", "invariants of the environment in random play, 1, 4, 8 and 15 robots, every "
            "scene", "0 violations in 1,000,000 joint steps", "environments:invariants"),
        Promise("R10", "the kernels agree with the slow reference in every byte", "0 of 20,000 "
            "joint steps differ", "environments:reference"),
        Promise("R11", "planted bugs in environments, buffers and losses are caught by "
            "sb3_roles.testing", "30/30", "planted:bugs"),
        Promise("R12", "a NaN in observation, reward, advantage, loss or gradient stops training "
            "before any weight changes", "5/5", "not_finite:injections"),
        Promise("R13", "the same seed in fresh processes with other hash seeds: the same weights, "
            "logs and tables", "5/5", "determinism:processes"),
        Promise("R14", "Ray with a worker killed in each round: the results of no Ray",
            "identical for 1 and 2 workers", "determinism:ray"),
        Promise("R15", "SIGTERM at random instants: out within 10 s, the run loads, no process "
            "and no temporary file stays", "20/20", "kills:terminations"),
        Promise("R16", "memory does not grow in 5,000,000 robot steps of training",
            "below 2 % after warm-up", "memory:growth", has_quick=False),
        Promise("R17", "the tests pass again and again on a busy machine", "5 of 5 times",
            "suite:repeats", has_quick=False),
    )
}  # fmt: skip
