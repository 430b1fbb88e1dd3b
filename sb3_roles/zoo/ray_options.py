"""``--ray`` of ``train``: several runs on a cluster, or the rollouts of one run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.machine import usable_cores
from sb3_roles.zoo.options import UsageError, whole_number

if TYPE_CHECKING:
    from types import ModuleType

LOCAL = "local"
_SPLITS = "rollout_groups"
# Of observations of one rollout and their way back.
_STORE_BYTES = 500_000_000


def add_ray_options(add: Callable[..., None]) -> None:
    """Add the options.

    :param add: ``add_argument`` of the command
    """
    add("--ray", metavar="ADDRESS", help="use a Ray cluster: its address, auto, or "
        f"{LOCAL!r} to start one here (extra ray). Several runs (--n-seeds, --algo, --vary) go "
        "side by side, each on --num-threads CPUs, in a log folder that all machines share; with "
        "--rollout-workers one run's rollouts are played there")  # fmt: skip
    add("--rollout-workers", type=whole_number(1, 1024), metavar="K", help="Ray tasks that play "
        f"rollouts at once, at most the configuration's {_SPLITS}; however many there are, and "
        "whichever of them die, the weights are those of a run without Ray")  # fmt: skip


def check_ray_options(options: Mapping[str, Any], config: Mapping[str, Any], several: bool) -> None:
    """Find out whether options go together.

    :param options: of the command
    :param config: of a run, checked
    :param several: whether the command asks for several runs
    :raises UsageError: if they do not
    """
    address, workers = options.get("ray"), options.get("rollout_workers")
    if address is None:
        if workers is not None:
            raise UsageError("--rollout-workers needs --ray ADDRESS")
        return
    if workers is None:
        if not several:
            raise UsageError(
                "--ray needs several runs (--n-seeds, --algo, --vary) to go side by side, or "
                "--rollout-workers K, for the rollouts of one run"
            )
        return
    if several:
        raise UsageError(
            "--ray takes several runs (--n-seeds, --algo, --vary) to go side by side, or "
            "--rollout-workers, for the rollouts of one run, not both"
        )
    splitting = [name for name, one in ALGORITHMS.items() if _SPLITS in one.parameters]
    if config["algo"] not in splitting:
        raise UsageError(
            f"--rollout-workers: {config['algo']} plays its rollouts itself; allowed for "
            f"{', '.join(splitting)}"
        )
    groups = config.get(_SPLITS, 1)
    if workers > groups:
        raise UsageError(
            f"--rollout-workers {workers}: the configuration's {_SPLITS} is {groups}, and each "
            "group is played by one worker; lower the one or raise the other (-params "
            f"{_SPLITS}:{workers})"
        )


def connected_to(address: str) -> ModuleType:
    """Connect to a cluster, and return the module for it.

    :param address: what ``--ray`` gives
    :raises UsageError: if Ray is not installed, or there is no such cluster
    """
    cluster = import_ray()
    try:
        cluster.connect(address, usable_cores(), _STORE_BYTES)
    except cluster.RayError as error:
        raise UsageError(f"argument --ray: {error}") from None
    return cluster


def import_ray() -> ModuleType:
    """Import what needs Ray.

    :raises UsageError: if it is not installed
    """
    try:
        return import_module("sb3_roles.common.ray_cluster")
    except ImportError:
        raise UsageError("argument --ray: install sb3_roles[ray] to use it") from None


@contextmanager
def rollouts_on_ray(
    model: Any, config: Mapping[str, Any], options: Mapping[str, Any]
) -> Iterator[None]:
    """Let a cluster play the rollouts of a model, if the options say so.

    :param model: to be trained
    :param config: of the run, checked
    :param options: of the command, checked
    :raises UsageError: if the environment can not be played in parts, or there is no such cluster
    """
    workers = options.get("rollout_workers")
    if workers is None:
        yield
        return
    from sb3_roles.common.env_state import env_gap

    gap = env_gap(model.env)
    if gap is not None:
        raise UsageError(
            f"--rollout-workers: {gap}, with which its teams would travel: leave the option out, "
            "or give the environment get_state() and set_state(state)"
        )
    if model.device.type != "cpu":
        raise UsageError("--rollout-workers act on CPUs, and so must the run: add --device cpu")
    from sb3_roles.common.snapshot import kept_rng

    here = model.player
    with kept_rng():
        cluster = connected_to(options["ray"])
    try:
        with kept_rng():
            from sb3_roles.zoo.ray_rollouts import RayPlayer
        model.player = RayPlayer(model, config, workers)
        yield
    finally:
        model.player = here
        cluster.disconnect()
