"""What a learned row of a plan trains: its configuration, and the command line of its runs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_roles.common.names import closest
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config import ConfigError, config_file, load_settings, merge, resolve
from sb3_roles.zoo.environments import AREA_SEARCH

if TYPE_CHECKING:
    from sb3_roles.evaluation.grid.plan import Row

LOGS = Path("logs")
PLAN, ABLATIONS = "tables", "ablations"
"""Stems of the files that name rows, which are beside the configurations."""
# Two runs that differ in these alone are runs of one configuration. What a file of demonstrations
# holds is noted in the run itself; who recorded them is a key of its own.
_FREE = ("seed", "n_timesteps", "vec_env", "demonstrations")
_N_SEEDS = 3


def method_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a configuration has in common with those of other runs of its method.

    :param config: checked
    """
    from sb3_roles.zoo.models import complete

    return {key: value for key, value in complete(config).items() if key not in _FREE}


def method_of_row(row: Row) -> dict[str, Any]:
    """Return what the runs of a learned row have in common, see :func:`method_of`.

    :param row: a learned one
    :raises ConfigError: see :func:`config_of_row`
    """
    return method_of(config_of_row(row))


def config_of_row(row: Row, what: str = "row") -> dict[str, Any]:
    """Return the configuration that a run of a learned row has.

    :param row: a learned one
    :param what: it is called in the message of an error
    :raises ConfigError: naming the row, if its algorithm, its file or its parameters are wrong
    """
    assert row.algo is not None
    try:
        if row.algo not in ALGORITHMS:
            raise ConfigError([closest("algorithm", row.algo, ALGORITHMS)])
        conf = row.conf or row.algo
        known = sorted({path.stem for path in config_file(conf).parent.glob("*.yml")})
        known = [stem for stem in known if stem not in (PLAN, ABLATIONS)]
        if conf not in known:
            raise ConfigError([closest("conf", conf, known)])
        settings = load_settings(row.algo, AREA_SEARCH, config_file(conf))
        return resolve(row.algo, AREA_SEARCH, merge(settings, row.params))
    except ConfigError as error:
        raise ConfigError(f"{what} {row.name}: {line}" for line in error.lines) from None


def training_command(
    row: Row,
    logs: Path = LOGS,
    seeds: range = range(_N_SEEDS),
    n_timesteps: int | None = None,
) -> str:
    """Return the command line that trains the runs of a learned row.

    :param row: a learned one
    :param logs: folder of the runs
    :param seeds: of the runs, at least one
    :param n_timesteps: joint steps, instead of the configuration's
    """
    assert row.algo is not None
    words = ["sb3-roles", "train", "--algo", row.algo]
    if row.conf is not None:
        words += ["--conf-file", _relative(config_file(row.conf))]
    if n_timesteps is not None:
        words += ["-n", str(n_timesteps)]
    if seeds.start:
        words += ["--seed", str(seeds.start)]
    words += ["--n-seeds", str(len(seeds))]
    if logs != LOGS:
        words += ["-f", str(logs)]
    if row.params:
        import yaml

        words.append("-params")
        for key, value in row.params.items():
            text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
            words.append(f"{key}:{text.removesuffix(chr(10)).removesuffix('...').strip()}")
    return shlex.join(words)


def _relative(path: Path) -> str:
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
