"""R11: are planted bugs caught by the checks that everyone can call?"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pettingzoo.test import parallel_api_test, parallel_seed_test

from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.losses import stream_loss
from sb3_roles.prove.planted_buffers import BUFFER_BUGS
from sb3_roles.prove.planted_environments import ENVIRONMENT_BUGS, HORIZON, SmallSearch
from sb3_roles.prove.planted_losses import LOSS_BUGS
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.testing import (
    ConformanceError,
    check_parallel_env,
    check_stream_loss,
    check_team_buffer,
)

# The environment's episodes have 12 steps: this bounds one that never ends, also for PettingZoo.
_N_STEPS = 40


@dataclass(frozen=True)
class Bug:
    """A bug, and the check that should find it.

    :param kind: ``environment``, ``buffer`` or ``loss``
    :param name: what it breaks
    :param planted: the class or function that has it
    """

    kind: str
    name: str
    planted: Callable[..., Any]

    def found(self, seed: int) -> str | None:
        """Return what the check says of it; None if it finds nothing.

        :param seed: of play
        """
        return finding(self.kind, self.planted, seed)


BUGS = tuple(
    Bug(kind, name, planted)
    for kind, bugs_of_kind in (
        ("environment", ENVIRONMENT_BUGS),
        ("buffer", BUFFER_BUGS),
        ("loss", LOSS_BUGS),
    )
    for name, planted in bugs_of_kind.items()
)
RIGHT: dict[str, Callable[..., Any]] = {
    "environment": SmallSearch,
    "buffer": TeamRolloutBuffer,
    "loss": stream_loss,
}


def finding(kind: str, tried: Callable[..., Any], seed: int) -> str | None:
    """Return what the check of a kind of thing says of one; None if it finds nothing.

    :param kind: ``environment``, ``buffer`` or ``loss``
    :param tried: the class or function
    :param seed: of play
    """
    try:
        if kind == "environment":
            check_parallel_env(tried, _N_STEPS, seed, max_episode_steps=100, horizon=HORIZON)
        elif kind == "buffer":
            check_team_buffer(tried, seed)
        else:
            check_stream_loss(tried, seed)
    except ConformanceError as error:
        return str(error)
    return None


def found_by_pettingzoo(make_env: Callable[[], Any]) -> bool:
    """Whether PettingZoo's API test or seed test fails; its warnings do not count.

    :param make_env: makes a new environment
    """
    with _silence():
        try:
            parallel_api_test(make_env(), num_cycles=_N_STEPS)
            parallel_seed_test(make_env, num_cycles=_N_STEPS)
        except Exception:  # The tests also stumble over what they do not expect.
            return True
    return False


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def bugs(setting: Setting) -> Outcome:
    """R11: each planted bug is found, and nothing is found in what has none.

    The short form is the full one.

    :param setting: how
    """
    failures = []
    for kind, right in RIGHT.items():
        said = finding(kind, right, setting.seed)
        if said is not None:
            failures.append(f"{kind} without a bug: {said}")
    held = 0
    for bug in BUGS:
        said = bug.found(setting.seed)
        held += said is not None
        if said is None:
            failures.append(f"{bug.kind}: {bug.name}: not found")
        setting.note(f"missed {bug.name}" if said is None else f"caught {bug.name}: {said}")
    in_environments = [bug for bug in BUGS if bug.kind == "environment"]
    by_stock = sum(found_by_pettingzoo(bug.planted) for bug in in_environments)
    return Outcome(
        held,
        len(BUGS),
        "planted bugs caught, nothing found in what has none",
        tuple(failures),
        f"PettingZoo's API and seed tests: {by_stock} of the {len(in_environments)} in "
        "environments",
    )
