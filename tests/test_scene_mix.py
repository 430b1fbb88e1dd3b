"""A mix of scenes in one batch: each team plays as it would in a batch of its own scene."""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers import one_line

from area_search import AreaSearchEnv, BatchedAreaSearch, Scene, SceneError
from area_search.scenes import get_scenes
from sb3_roles import HMAPPO, RoleWrapper, make_team_vec_env
from sb3_roles.baselines.area import area_scene, area_scenes
from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation.evaluators import MixEvaluator, SceneEvaluator, make_evaluator
from sb3_roles.evaluation.grid.plan import Row
from sb3_roles.zoo.cli import main
from sb3_roles.zoo.config import ConfigError, config_file, read_yaml, resolve
from sb3_roles.zoo.row_runs import RunFinder

SMALL: dict[str, Any] = {"height": 9, "width": 10, "n_agents": 3, "horizon": 8}
MIX = (
    Scene(name="dense", free_fraction=0.9, n_targets=30, **SMALL),
    Scene(name="sparse", free_fraction=0.5, n_targets=4, early_stop_patience=5, **SMALL),
    Scene(name="odd", n_targets=9, explore_normalizer=5.0, spawn_sigma=2.0, alpha=1.0, **SMALL),
)
N_TEAMS = 7
SCENES_OF_TEAMS = [0, 0, 0, 1, 1, 2, 2]


def play(batch: BatchedAreaSearch, seeds: list[int], steps: int = 20) -> list[dict[str, Any]]:
    """Play moves that are those of the team's seed; return all that can be seen at each step."""
    rngs = [np.random.default_rng(seed) for seed in seeds]
    batch.reset(seeds)
    found = []
    for _ in range(steps):
        batch.step(np.stack([rng.integers(0, 5, batch.n_agents) for rng in rngs]))
        seen: dict[str, Any] = {name: value.copy() for name, value in batch.observations.items()}
        for name in ("rewards", "reward_components", "metric_values", "terminated", "truncated"):
            seen[name] = getattr(batch, name).copy()
        seen["episode"] = [batch.episode_metrics(m) for m in range(batch.n_teams)]
        seen["title"] = [batch.snapshot(m).title for m in range(batch.n_teams)]
        found.append(seen)
        batch.reset_teams(batch.terminated | batch.truncated)
    return found


@pytest.mark.parametrize("n_threads", [1, 2, 3])
@pytest.mark.parametrize("sub_goal", ["none", "assigned", "routes"])
def test_teams_play_as_in_batches_of_their_own_scenes(sub_goal: str, n_threads: int) -> None:
    mixed = BatchedAreaSearch(MIX, N_TEAMS, sub_goal, True, n_threads)
    assert [mixed.scene_of(m) for m in range(N_TEAMS)] == [MIX[k] for k in SCENES_OF_TEAMS]
    together = play(mixed, list(range(N_TEAMS)))
    ended = 0
    for k, scene in enumerate(MIX):
        teams = [m for m in range(N_TEAMS) if SCENES_OF_TEAMS[m] == k]
        alone = play(BatchedAreaSearch(scene, len(teams), sub_goal, True), teams)
        for one, other in zip(together, alone, strict=True):
            for name, value in other.items():
                mine = [one[name][m] for m in teams]
                np.testing.assert_array_equal(mine, value, err_msg=name)
            ended += int(other["terminated"].sum() + other["truncated"].sum())
    assert ended > N_TEAMS


def test_scenes_travel_with_the_state_of_their_teams() -> None:
    whole = BatchedAreaSearch(MIX, N_TEAMS, "routes")
    play(whole, list(range(N_TEAMS)), 3)
    actions = np.random.default_rng(5).integers(0, 5, (4, N_TEAMS, 3))
    # As groups of teams are sent to workers: two teams, of the second and the third scene.
    part = BatchedAreaSearch(MIX, 2, "routes", n_threads=2)
    part.set_state({name: value[4:6] for name, value in whole.get_state().items()})
    copied = pickle.loads(pickle.dumps(part))
    for moves in actions:
        whole.step(moves)
        for batch in (part, copied):
            batch.step(moves[4:6])
            assert [batch.scene_of(m).name for m in range(2)] == ["sparse", "odd"]
            for name, value in batch.observations.items():
                np.testing.assert_array_equal(value, whole.observations[name][4:6])
            np.testing.assert_array_equal(batch.rewards, whole.rewards[4:6])
            np.testing.assert_array_equal(batch.metric_values, whole.metric_values[4:6])
        for batch in (whole, part, copied):
            batch.reset_teams(batch.terminated | batch.truncated)


def test_a_state_of_another_mix_is_refused() -> None:
    batch = BatchedAreaSearch(MIX, 3)
    batch.reset([0, 1, 2])
    state = batch.get_state()
    with pytest.raises(ValueError, match="scene_index must be below 2"):
        BatchedAreaSearch(MIX[:2], 3).set_state(state)
    with pytest.raises(ValueError, match="unknown arrays scene_index"):
        BatchedAreaSearch(MIX[0], 3).set_state(state)


@pytest.mark.parametrize(
    ("scenes", "said"),
    [
        ([], "at least one"),
        (["easy", "hrad"], "did you mean 'hard'"),
        (["easy", "easy"], "once, got easy twice"),
        ([Scene(), Scene(name="far", horizon=60)], "agree in horizon: it is 50 in hard, 60 in far"),
        ([Scene(), Scene(name="wide", width=30)], "agree in width"),
        ([Scene(), Scene(name="more", n_agents=8)], "agree in n_agents"),
        ([Scene(), 3], "a name or a Scene, got int"),
    ],
)
def test_scenes_that_are_no_mix(scenes: Any, said: str) -> None:
    with pytest.raises(SceneError) as error:
        get_scenes(scenes)
    assert said in one_line(error.value)


def test_one_team_plays_no_mix() -> None:
    env = AreaSearchEnv(MIX)
    with pytest.raises(ValueError, match=r"one team can not play a mix .*native backend"):
        env.reset(seed=0)
    with pytest.raises(ValueError, match="where one is needed"):
        _ = BatchedAreaSearch(MIX, 3).scene
    with pytest.raises(ValueError, match="native backend"):
        make_team_vec_env(lambda: AreaSearchEnv(MIX), 3, backend="supersuit").reset()
    # A list of one scene is that scene.
    assert AreaSearchEnv([MIX[0]]).scene == MIX[0]


@pytest.mark.parametrize(
    ("algo", "env_kwargs", "changes", "said"),
    [
        ("hmappo", {"scene": ["easy", "hrad"]}, {}, "did you mean 'hard'"),
        ("hmappo", {"scene": []}, {}, "at least one"),
        ("hmappo", {"scene": ["easy", "easy"], "n_agents": 8, "horizon": 40}, {}, "easy twice"),
        ("hmappo", {"scene": ["easy", "hard"]}, {"n_envs": 1}, "at least the number of scenes, 2"),
        ("hmappo", {"scene": ["easy", "hard"]}, {"vec_env": "supersuit"}, "with vec_env supersuit"),
        ("gnn", {"scene": ["easy", "hard"], "known_map": True}, {}, "one scene for gnn, got 2"),
        ("mappo", {"scene": ["easy", "hard"], "n_targets": 0}, {}, "n_targets must be"),
    ],
)
def test_configurations_that_are_no_mix(
    algo: str, env_kwargs: dict[str, Any], changes: dict[str, Any], said: str
) -> None:
    settings = {"n_timesteps": 100, "n_envs": 4, "env_kwargs": env_kwargs, **changes}
    vec_env = settings.pop("vec_env", "auto")
    with pytest.raises(ConfigError) as error:
        resolve(algo, "area-search-v0", settings, vec_env=vec_env)
    assert len(error.value.lines) == 1
    assert said in error.value.lines[0]


def test_a_policy_is_evaluated_on_each_scene() -> None:
    make = partial(AreaSearchEnv, MIX)
    env = make_team_vec_env(make, 3, expand_team_observations=False)
    model = HMAPPO("RolePolicy", RoleWrapper(env), n_steps=8, batch_size=8, device="cpu", seed=0)
    assert area_scenes(model.env) == MIX
    with pytest.raises(ValueError, match=r"a mix of scenes \(dense, sparse, odd\)"):
        area_scene(model.env)
    evaluate = make_evaluator(model, 10, stream="selection")
    assert isinstance(evaluate, MixEvaluator)
    assert evaluate.note == "mean of dense, sparse, odd"
    scores = evaluate(model)
    alone = [SceneEvaluator(scene, 4, stream="selection")(model) for scene in MIX]
    assert scores["n_episodes"] == 12
    for name in ("explo_paper", "explo_true", "cover"):
        assert scores[name] == pytest.approx(sum(one[name] for one in alone) / 3)
    for scene, one in zip(MIX, alone, strict=True):
        assert scores[f"cover_{scene.name}"] == one["cover"]


SCENES = ("easy", "hard", "obstacles_52")
TINY = f"env_kwargs:{{scene: [{', '.join(SCENES)}], n_agents: 2, horizon: 6}}"
TRAIN = [
    *("train", "--num-threads", "1", "--device", "cpu", "--eval-freq", "40", "-n", "96"),
    *("--eval-episodes", "5", "--save-freq", "32", "-params", "n_envs:4", "n_steps:8"),
    *("batch_size:16", "n_epochs:1", TINY),
]


def test_a_run_on_a_mix_goes_on_where_it_was(tmp_path: Path, capsys: Any) -> None:
    assert main([*TRAIN, "-f", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "joint steps: cover " in said and "(mean of easy, hard, obstacles_52)" in said
    assert "6 held-out episodes of seed 1, mean of easy, hard, obstacles_52: explo_paper" in said
    run = tmp_path / "hmappo" / "area-search-v0_1"
    scores = yaml.safe_load((run / "evaluation.yml").read_text())["scores"]
    assert scores["cover"] == pytest.approx(np.mean([scores[f"cover_{name}"] for name in SCENES]))
    assert "cover_obstacles_52" in (run / "evaluations.csv").read_text().splitlines()[0]
    log = (run / "evaluations.csv").read_text()
    expected = CheckpointFolder(run / "checkpoints").newest()[1].policy
    # The last third once more, from the checkpoint before it.
    _, last = sorted((run / "checkpoints").glob("*.ckpt"))
    last.unlink()
    assert main(["train", "--resume", str(run)]) == 0
    said = capsys.readouterr().out
    assert "joint steps 64 to 96" in said and "not bit-exact" not in said
    found = CheckpointFolder(run / "checkpoints").newest()[1].policy
    assert all(value.equal(found[name]) for name, value in expected.items())
    assert (run / "evaluations.csv").read_text() == log
    # Who watches it names a scene.
    watch = ["enjoy", "-f", str(run), "--no-render", "--episodes", "1"]
    with pytest.raises(SystemExit):
        main(watch)
    said = capsys.readouterr().err
    assert "trained on a mix of scenes (easy, hard, obstacles_52): add --scene NAME" in said
    assert main([*watch, "--scene", "easy"]) == 0
    # It is found by its configuration, as the row of the tables.
    rows = read_yaml(config_file("tables"))["rows"]
    row = Row("mix", **{**rows["hmappo_mix"], "params": _params(TRAIN)})
    assert [one.folder for one in RunFinder(tmp_path).find(row)] == [run]
    other = {**_params(TRAIN), "env_kwargs": {"scene": "easy", "n_agents": 2, "horizon": 6}}
    assert RunFinder(tmp_path).find(Row("mix", **{**rows["hmappo_mix"], "params": other})) == []


def _params(words: list[str]) -> dict[str, Any]:
    pairs = (word.partition(":") for word in words[words.index("-params") + 1 :])
    return {key: yaml.safe_load(value) for key, _, value in pairs}
